"""Measurements that releases need and users do not: `make bench`, or PYTHONPATH=tests python -m bench.MODULE.

release       everything of `wavebatch bench`, other decomposers, stiff cases, start-up, memory, jobs, promised figures
against       this wavebatch and another version take turns on the same strips
"""
