"""Models, tasks, reference computations and folders that several test modules use."""
