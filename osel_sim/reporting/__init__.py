"""Figures, tables and the one-page report: said once, drawn for the screen and for print."""
