"""Computer and process around a run: devices, processes, files, provenance."""
