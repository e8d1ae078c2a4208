"""Files that are read and written: tasks, policies, outcomes, journal, rollout log."""
