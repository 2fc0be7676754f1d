"""Commands of ``sb3-chac``, one module each."""
