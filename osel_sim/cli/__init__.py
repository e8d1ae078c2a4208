"""What the commands share: flags from configurations, tables and messages on the terminal."""
