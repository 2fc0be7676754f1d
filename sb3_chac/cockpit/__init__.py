"""A person at the wheel: devices, the window and the browser page, and training that goes on beside the driving."""
