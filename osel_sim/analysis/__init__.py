"""What can be learned from logged outcomes alone: replay, oracles, gaps, a verdict, off-policy estimates."""
