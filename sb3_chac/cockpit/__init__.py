"""A person at the wheel: devices, the window, and training that goes on beside the driving."""
