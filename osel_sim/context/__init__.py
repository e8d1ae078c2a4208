"""Encoders: an instance's images and instruction as one vector, and the cache of such vectors."""
