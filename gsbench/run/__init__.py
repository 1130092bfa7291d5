"""Run one training of a model on a scene, measure the result and write its record.

Importing this module imports neither torch nor other large packages.
"""
