"""The simulated bench: the boards' own programs on simulated chips, sensors and radio."""
