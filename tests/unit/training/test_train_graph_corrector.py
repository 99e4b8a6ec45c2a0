"""Graphs to learn from, and a training of the learned corrector at toy size."""

from pathlib import Path

import numpy as np

from ngo_estimator.checkpoint import load_loop_attention
from training.scoring.drawn_graphs import TRAIN_SEEDS, VALIDATION_SEEDS, drawn
from training.train_graph_corrector import Arguments, main


def test_drawn_graphs_have_all_that_the_cells_of_the_table_fix() -> None:
    judged = [drawn(seed) for seed in TRAIN_SEEDS[:40]]
    wrong = np.array([1.0 - each.right.mean() for each in judged])
    places = np.array([(each.problem.loops.degrees == 2).mean() for each in judged])
    density = np.array([len(each.right) / len(each.truth) for each in judged])
    assert wrong.min() < 0.25 and wrong.max() > 0.7
    assert (places == 0.0).any() and (places == 1.0).any() and ((places > 0.1) & (places < 0.9)).any()
    assert density.min() < 0.5 and density.max() > 2.0
    assert not set(TRAIN_SEEDS) & set(VALIDATION_SEEDS)


def test_a_training_writes_a_network_that_is_read_back(tmp_path: Path) -> None:
    arguments = Arguments(epochs=1, steps=3, batch_size=1, validation=1, out=tmp_path / "out", runs=tmp_path / "runs")
    metrics = main(arguments)
    network, described = load_loop_attention(tmp_path / "out" / "graphs")
    assert metrics["corrected"] > 0.0 and network.config.attention
    assert described["metrics"]["validation"] == metrics
