"""The Neural Graph Optimizer: loops, gates, Gauss-Newton."""
