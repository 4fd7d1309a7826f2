"""What LeRobot imports when it looks for plugins: registers policy ``lansar`` and environment ``calvin``."""
