"""Scenes, control, cameras, success predicates and the scripted expert: the robot's world, which knows nothing of selectors."""
