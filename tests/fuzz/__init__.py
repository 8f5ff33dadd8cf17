"""Random problems, bad inputs and kills: what the package promises has to hold for all of them.

`python -m scripts.fuzz --help` runs it by hand. docs/development/reliability.md has what it covers.
"""
