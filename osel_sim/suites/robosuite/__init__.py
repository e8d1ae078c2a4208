"""robosuite's own single-arm environments (ARISE Initiative), with any of its arms that load."""
