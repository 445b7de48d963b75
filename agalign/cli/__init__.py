"""The command line: parses, calls the library, prints.

In: arguments. Out: text, and an exit code.
"""
