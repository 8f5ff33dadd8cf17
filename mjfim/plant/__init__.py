"""The model as discrete-time dynamics with outputs, noise, delay and derivatives."""
