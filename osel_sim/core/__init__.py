"""What everything stands on: errors, files, content, processes."""
