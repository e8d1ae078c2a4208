"""Training of policies from demonstrations: recipe, data cache, batches, loop, evaluation."""
