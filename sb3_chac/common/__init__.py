"""Ground of the package, which imports none of its other parts."""
