"""`python -m tailgate`: run the command line where the scripts of an environment are not on the path."""

from tailgate.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
