"""The functions that users call from Python as `wavebatch.open_strip`, `wavebatch.run`, ...; commands call them too.

`wavebatch/__init__.py` lists them and imports a module of this folder when one of its names is first used.
"""
