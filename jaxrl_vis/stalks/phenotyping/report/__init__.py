"""Results of a plot for people: tables, overlays, the page qc.html and figures."""
