"""The computer: processes, memory, text, and files that are written completely or not at all.

In: paths and functions. Out: files, results of worker processes.
"""
