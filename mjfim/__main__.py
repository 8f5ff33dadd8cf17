"""`python -m mjfim`."""

from mjfim.cli.main import main

if __name__ == "__main__":
    main()
