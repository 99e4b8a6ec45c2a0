"""The Neural Graph Optimizer: the paper's section "Neural Graph Optimization", step by step.

=====================================================  ================================================
Paper                                                  Here
=====================================================  ================================================
Pose aggregation: features F^(0) of meta-poses         ``pose_aggregation.PoseAggregation``
Delta P, and P = r2g(Delta P)                          ``meta_poses``; ``geometry.se2.r2g``
Attention phase: q, C_tu = <q_t, f_u>, alpha, a        ``attention_network.AttentionNetwork.attend``
Optimization: convolutions give F, nabla P and beta    ``attention_network.AttentionPhases.optimise``
Delta P^(i) = Delta P^(i-1) + beta^(i) nabla P^(i)     the same
M iterations                                           ``neural_graph_optimizer.NeuralGraphOptimizer``
=====================================================  ================================================

Not in the paper, whose attention has to learn loop closures: ``registered_odometry`` measures the odometry again before
the first iteration, ``loop_judge`` and ``loop_gates`` say which loops to trust, and each iteration ends with a
Gauss-Newton step of ``loop_closing`` that closes them. ``warm_start`` goes on from an earlier optimisation,
and ``whole_trajectory`` is the optimizer offline.
"""
