"""Any gymnasium environment whose info says whether the task is done."""
