"""Assessment of a fit: accuracy, residual tests, predictions, draws and the report of them."""
