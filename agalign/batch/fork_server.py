"""Imported by the fork server, from which workers are forked: it can import modules, but not call functions."""

from agalign.batch.preload import preload_libraries

preload_libraries()
