"""Benchmarks: timings, comparisons with other solvers, and the tables of docs/benchmarks.md;
`python -m scripts.benchmarks`.
"""
