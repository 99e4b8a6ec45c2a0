"""The pose graph: nodes, key frames, factors, and the solver without gradients. Not in the paper."""
