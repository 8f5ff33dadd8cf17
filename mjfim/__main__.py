"""`python -m mjfim`."""

from mjfim.cli import main

if __name__ == "__main__":
    main()
