"""Control laws in the loop: simulations in which they compute the controls."""
