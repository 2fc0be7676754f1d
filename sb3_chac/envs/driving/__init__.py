"""Parts that both driving tasks share."""
