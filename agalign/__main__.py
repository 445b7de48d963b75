"""`python -m agalign` is `agalign`."""

from agalign.cli import main

if __name__ == "__main__":
    main()
