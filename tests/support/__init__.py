"""Models, setups, reference computations and folders that several test modules use."""
