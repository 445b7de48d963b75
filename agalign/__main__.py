"""`python -m agalign` is `agalign`."""

from agalign.cli.main import main

if __name__ == "__main__":
    main()
