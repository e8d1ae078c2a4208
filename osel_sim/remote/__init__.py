"""A policy behind a network: wire protocol, server, client, and a network simulated on a virtual clock."""
