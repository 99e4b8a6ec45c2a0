"""The Neural Graph Optimizer, as the paper has it, and its loop closing."""
