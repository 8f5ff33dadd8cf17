"""Pictures of results as data, and the files that matplotlib draws of them."""
