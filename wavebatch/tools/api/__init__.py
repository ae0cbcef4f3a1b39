"""The functions that users call from Python as `wavebatch.open_strip`, `wavebatch.run`, ...; commands call them too.

`wavebatch/__init__.py` lists them and imports their modules when a name is first used.
"""
