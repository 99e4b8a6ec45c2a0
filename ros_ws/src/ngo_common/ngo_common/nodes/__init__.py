"""Parameters, quality of service, and the process around a node."""
