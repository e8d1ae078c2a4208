"""Training of the embedded context encoder."""
