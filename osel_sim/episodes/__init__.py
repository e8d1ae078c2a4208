"""What the commands that run episodes share: drivers, subscribers, video, the live loop, worker processes."""
