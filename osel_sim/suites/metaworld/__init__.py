"""Meta-World: 50 tasks of a Sawyer arm on a table (metaworld, Farama Foundation)."""
