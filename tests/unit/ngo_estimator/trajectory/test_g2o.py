"""Files of g2o, and their graphs as the corrector solves them."""

import gzip
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ngo_estimator.geometry.se2 import between, compose
from ngo_estimator.graph.cycle_agreement import chain_poses
from ngo_estimator.graph.robust import Robust
from ngo_estimator.slam.trajectory_update import Trajectory
from ngo_estimator.trajectory.chained_graph import ChainedGraph, chained
from ngo_estimator.trajectory.g2o import UNSTAMPED, PlanarGraph, g2o_lines, graph_of_frames, read_g2o, write_g2o

SQUARE = (
    "VERTEX_SE2 0 0 0 0\n"
    "VERTEX_SE2 1 1 0 1.5\n"
    "VERTEX_SE2 2 1 1 3\n"
    "FIX 0\n"
    "EDGE_SE2 0 1 1 0 1.5 4 1 0 4 0 16\n"
    "EDGE_SE2 1 2 1 0 1.5 4 0 0 4 0 16\n"
    "EDGE_SE2 0 2 1 1 3 1 0 0 1 0 0 # loop 0.25\n"
)
NUMBERS = st.floats(-1e12, 1e12, allow_nan=False)


@st.composite
def graphs(draw: st.DrawFn) -> PlanarGraph:
    """Any graph, of vertices in any order."""
    count = draw(st.integers(2, 6))
    ids = np.array(draw(st.lists(st.integers(0, 2**62), min_size=count, max_size=count, unique=True)))
    edges = draw(st.lists(st.permutations(range(count)).map(lambda order: order[:2]), min_size=1, max_size=8))
    rows = len(edges)

    def numbers(n: int, values: st.SearchStrategy[float], k: int = 3) -> np.ndarray:
        return np.array(draw(st.lists(values, min_size=n * k, max_size=n * k))).reshape(n, k)

    off = numbers(rows, st.floats(-0.3, 0.3))
    information = np.zeros((rows, 3, 3))
    information[:, [0, 0, 1], [1, 2, 2]] = off
    size = 10.0 ** numbers(rows, st.floats(-6.0, 9.0))
    information = (information + information.mT + np.eye(3)) * size[:, :, None] * size[:, None, :]
    upper = np.triu(information)
    information = upper + np.triu(information, 1).mT
    believed = numbers(rows, st.floats(0.0, 1.0) | st.just(float("nan")), 1)[:, 0]
    stamps = st.integers(0, 2**62) | st.just(UNSTAMPED)
    return PlanarGraph(
        ids, numbers(count, NUMBERS), np.array(draw(st.lists(stamps, min_size=count, max_size=count))),
        ids[np.array(edges)], numbers(rows, NUMBERS), information,
        np.array(draw(st.lists(st.booleans(), min_size=rows, max_size=rows))), believed,
        tuple(ids[: draw(st.integers(0, 1))].tolist()),
    )  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(graphs())
def test_what_is_written_is_read_back_to_the_last_bit(
    tmp_path_factory: pytest.TempPathFactory, graph: PlanarGraph
) -> None:
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    write_g2o(path, graph)
    again = read_g2o(path)
    for name in ("ids", "poses", "stamps_ns", "edges", "relative", "information", "is_loop", "belief"):
        np.testing.assert_array_equal(getattr(again, name), getattr(graph, name), err_msg=name)
    assert again.fixed == graph.fixed and again.remarks == ()
    assert list(g2o_lines(again)) == path.read_text().splitlines()


def test_a_file_is_read_as_it_says(tmp_path: Path) -> None:
    (path := tmp_path / "square.g2o").write_text("# by hand\n\n" + SQUARE + "ROBOTLASER1 0 1 2\n")
    graph = read_g2o(path)
    assert graph.ids.tolist() == [0, 1, 2] and graph.fixed == (0,)
    assert graph.information[0].tolist() == [[4.0, 1.0, 0.0], [1.0, 4.0, 0.0], [0.0, 0.0, 16.0]]
    assert graph.is_loop.tolist() == [False, False, True] and graph.belief[2] == 0.25
    assert (graph.stamps_ns == UNSTAMPED).all() and graph.remarks == ("1 lines of ROBOTLASER1 were not read",)
    packed = tmp_path / "square.g2o.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert list(g2o_lines(read_g2o(packed))) == list(g2o_lines(graph))


def test_gtsam_reads_a_marked_file(tmp_path: Path) -> None:
    stamped = SQUARE.replace("0 0 0\n", "0 0 0 # stamp 1.5\n", 1)
    (path := tmp_path / "square.g2o").write_text(stamped.replace("1 0 0 #", "1 0 1 #"))  # it knows no missing heading
    write_g2o(tmp_path / "again.g2o", read_g2o(path))
    assert "VERTEX_SE2 0 0.0 0.0 0.0 # stamp 1.500000000" in (tmp_path / "again.g2o").read_text()
    graph, values = gtsam.readG2o(str(tmp_path / "again.g2o"), False)
    assert (values.size(), graph.size()) == (3, 3)
    assert graph.at(0).measured().equals(gtsam.Pose2(1.0, 0.0, 1.5), 0.0)
    np.testing.assert_allclose(graph.at(0).noiseModel().information(), [[4, 1, 0], [1, 4, 0], [0, 0, 16]], rtol=1e-12)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1", "line 8 is a VERTEX_SE3:QUAT; expected a planar graph"),
        ("VERTEX_XY 3 0 0", "line 8 is a VERTEX_XY; expected a planar graph"),
        ("EDGE_SE2_XY 0 3 0 0 1 0 1", "line 8 is a EDGE_SE2_XY; expected a planar graph"),
        ("VERTEX_SE2 2 1 1 3", "line 8 has the vertex 2 again; expected each once"),
        ("VERTEX_SE2 3 1 1", "line 8 has 4 words; expected VERTEX_SE2 id x y yaw"),
        ("VERTEX_SE2 3 1 one 3", "line 8 is 'VERTEX_SE2 3 1 one 3'; expected VERTEX_SE2 id x y yaw"),
        ("VERTEX_SE2 3.5 1 1 3", "line 8 is 'VERTEX_SE2 3.5 1 1 3'; expected VERTEX_SE2 id x y yaw"),
        ("VERTEX_SE2 3 1 nan 3", "line 8 has a value that is not finite"),
        ("VERTEX_SE2 3 1 1e200 3", "line 8 has a value that is not finite, or a pose beyond 1e+12; expected metres"),
        ("VERTEX_SE2 3 1 1 3 # stamp soon", "line 8 ends in '# stamp soon'; expected '# stamp' and seconds"),
        ("EDGE_SE2 1 1 0 0 0 1 0 0 1 0 1", "line 8 joins the vertex 1 with itself"),
        ("EDGE_SE2 0 2 0 0 0 1 2 0 1 0 1", "line 8 has the information 1 2 0 1 0 1; expected a positive definite"),
        ("EDGE_SE2 0 2 0 0 0 1 1 0 1 0 1", "line 8 has the information 1 1 0 1 0 1; expected a positive definite"),
        ("EDGE_SE2 0 2 0 0 0 1 0 0 -1 0 1", "line 8 has the information 1 0 0 -1 0 1; expected a positive definite"),
        ("EDGE_SE2 0 2 0 0 0 1 0 1 1 0 0", "line 8 has the information 1 0 1 1 0 0; expected a positive definite"),
        ("EDGE_SE2 0 2 0 0 0 0 0 0 0 0 0", "line 8 has the information 0 0 0 0 0 0; expected a positive definite"),
        ("EDGE_SE2 0 2 0 0 0 1 0 0 1 0 1 # loop 1.5", "line 8 ends in '# loop 1.5'; expected '# loop' or '# step'"),
        ("FIX", "line 8 is 'FIX'; expected FIX and the id of a vertex"),
        ("FIX 7", "line 8 fixes the vertex 7, which is not there"),
    ],
)  # fmt: skip
def test_a_fault_names_its_line_and_what_was_expected(tmp_path: Path, line: str, said: str) -> None:
    (path := tmp_path / "bad.g2o").write_text(SQUARE + line + "\n")
    with pytest.raises(ValueError) as error:
        read_g2o(path)
    assert str(error.value).startswith(f"{path}, {said}") and "\n" not in str(error.value)


def test_what_is_no_graph_is_one_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "bad.g2o"
    for content, said in ((b"", "there is no EDGE_SE2"), (b"VERTEX_SE2 0 0 0 0\n", "there is no EDGE_SE2"),
                          (b"\xff\xfe\x00", "is no text")):  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(ValueError, match=said):
            read_g2o(path)
    (tmp_path / "bad.g2o.gz").write_bytes(gzip.compress(SQUARE.encode())[:-12])
    with pytest.raises(ValueError, match="cannot be unpacked"):
        read_g2o(tmp_path / "bad.g2o.gz")
    with pytest.raises(ValueError, match=r"expected a name that ends in \.g2o"):
        write_g2o(tmp_path / "graph.txt", _square(tmp_path))


def _square(folder: Path) -> PlanarGraph:
    (path := folder / "square.g2o").write_text(SQUARE)
    return read_g2o(path)


def test_a_trajectory_becomes_its_odometry_and_its_loops(tmp_path: Path) -> None:
    odometry = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5 * np.pi], [1.0, 2.0, np.pi]])
    poses = np.array([[0.0, 0.0, 0.0], [1.25, -0.5, 0.5 * np.pi], [1.5, 2.0, -3.0]])
    trajectory = Trajectory(
        np.array([0, 1_700_000_000_057_142_857, 1_700_000_000_114_285_714]), poses, odometry, poses, np.zeros(3),
        np.array([[0.1, 0.2, 0.5], [0.1, 0.2, 0.25]]), np.array([[0, 2]]), np.array([0.75]),
        np.array([[0.5, 1.5, -3.0]]), np.array([[0.5, 0.5, 0.1]]),
    )  # fmt: skip
    write_g2o(path := tmp_path / "path.g2o", graph_of_frames(trajectory))
    assert "# stamp 1700000000.057142857" in path.read_text() and path.read_text().endswith("# loop 0.75\n")
    graph, values = gtsam.readG2o(str(path), False)
    assert values.size() == len(poses) and graph.size() == 3
    for index, (x, y, yaw) in enumerate(poses):
        assert values.atPose2(index).equals(gtsam.Pose2(x, y, yaw), 1e-12)
    keys, information = [], []
    for k, relative in enumerate([(1.0, 0.0, 0.5 * np.pi), (2.0, 0.0, 0.5 * np.pi), (0.5, 1.5, -3.0)]):
        factor = graph.at(k)
        keys.append(tuple(factor.keys()))
        assert factor.measured().equals(gtsam.Pose2(*relative), 1e-12)
        information.append(factor.noiseModel().information())
    assert keys == [(0, 1), (1, 2), (0, 2)]
    np.testing.assert_allclose(information, [np.diag(d) for d in ((100, 25, 4), (100, 25, 16), (4, 4, 100))], rtol=1e-9)


INFORMATION = "100 3 2 80 -4 400"


def _ring(ids: list[int], drift: float = 0.05) -> tuple[list[str], np.ndarray]:
    """The lines of a square drive that ends where it began, and its poses by steps that turn a little too far."""
    turns = np.zeros(len(ids) - 1)
    turns[len(ids) // 4 :: len(ids) // 4] = 0.5 * np.pi
    relative = np.stack((np.ones(len(turns)), np.zeros(len(turns)), turns + drift / len(turns)), axis=1)
    poses = chain_poses(relative)
    lines = [f"VERTEX_SE2 {name} {x} {y} {yaw}" for name, (x, y, yaw) in zip(ids, poses.tolist(), strict=True)]
    lines += [
        f"EDGE_SE2 {a} {b} {x} {y} {yaw} {INFORMATION}"
        for a, b, (x, y, yaw) in zip(ids[:-1], ids[1:], relative.tolist(), strict=True)
    ]
    x, y, yaw = between(chain_poses(relative - (0.0, 0.0, drift / len(turns)))[-1], np.zeros(3))
    lines.append(f"EDGE_SE2 {ids[-1]} {ids[0]} {x} {y} {yaw} {INFORMATION}")
    return lines, poses


def _chained(folder: Path, lines: list[str]) -> ChainedGraph:
    (path := folder / "graph.g2o").write_text("\n".join(lines) + "\n")
    return chained(read_g2o(path))


def _solved(graph: ChainedGraph) -> PlanarGraph:
    return graph.corrected(Robust().correct(graph.problem))


def test_ids_order_and_the_direction_of_steps_change_nothing(tmp_path: Path) -> None:
    lines, _ = _ring(list(range(16)))
    expected = _solved(_chained(tmp_path, lines))
    assert expected.belief[-1] == 1.0 and np.isnan(expected.belief[:-1]).all()
    others, _ = _ring([3 + 7 * k**2 for k in range(16)])
    shuffled = [others[k] for k in np.random.default_rng(0).permutation(len(others))]
    mixed = _solved(_chained(tmp_path, shuffled))
    np.testing.assert_allclose(mixed.poses, expected.poses, atol=1e-9)
    assert np.nanmax(mixed.belief) == 1.0 and np.isnan(mixed.belief).sum() == 15


def test_a_step_that_was_measured_backwards_says_the_same(tmp_path: Path) -> None:
    lines, _ = _ring(list(range(16)))
    graph = _chained(tmp_path, lines)
    relative, covariance = graph.problem.steps.relative[2], np.linalg.inv(graph.problem.steps.information[2])
    rng = np.random.default_rng(0)
    drawn = compose(relative, np.zeros((200_000, 3))) + rng.multivariate_normal(np.zeros(3), 1e-6 * covariance, 200_000)
    back = between(drawn, np.zeros(3))
    x, y, yaw = between(relative, np.zeros(3))
    upper = np.linalg.inv(np.cov(back.T) * 1e6)[np.triu_indices(3)].tolist()
    lines[16 + 2] = f"EDGE_SE2 3 2 {x} {y} {yaw} {' '.join(map(str, upper))}"
    turned = _chained(tmp_path, lines).problem.steps
    np.testing.assert_allclose(turned.relative[2], relative, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(turned.information[2]), covariance, atol=0.02 * covariance.max())


def test_vertices_without_a_line_begin_where_the_steps_put_them(tmp_path: Path) -> None:
    lines, poses = _ring(list(range(16)))
    edges = [line for line in lines if line.startswith("EDGE")]
    graph = _chained(tmp_path, edges)
    np.testing.assert_allclose(between(graph.problem.poses, poses), 0.0, atol=1e-9)
    del edges[3]  # the second part begins where the first one ends: loops alone say where it lies
    broken = _chained(tmp_path, edges)
    assert broken.breaks == 1 and broken.problem.poses[4].tolist() == broken.problem.poses[3].tolist()
    np.testing.assert_allclose(between(broken.problem.poses[4], broken.problem.poses[15]), between(poses[4], poses[15]))


def test_parts_that_nothing_joins_are_both_solved(tmp_path: Path) -> None:
    (first, _), (second, _) = _ring(list(range(16))), _ring(list(range(100, 116)))
    graph = _chained(tmp_path, first + second)
    assert (graph.components, graph.breaks) == (2, 1)
    solved, alone = _solved(graph), _solved(_chained(tmp_path, first))
    for part in (slice(0, 16), slice(16, 32)):
        own = between(solved.poses[part.start], solved.poses[part])
        np.testing.assert_allclose(own, between(alone.poses[0], alone.poses), atol=1e-6)


def test_an_edge_that_is_marked_is_a_loop_and_one_without_heading_too(tmp_path: Path) -> None:
    lines, _ = _ring(list(range(16)))
    lines[16 + 3] += " # loop"
    lines[16 + 7] = lines[16 + 7].replace(INFORMATION, "100 3 0 80 0 0")
    graph = _chained(tmp_path, lines)
    assert graph.breaks == 2 and len(graph.problem.loops) == 3
    assert graph.problem.loops.degrees.tolist() == [3, 2, 3]


def test_of_two_edges_between_neighbours_the_step_is_the_one_that_the_vertices_were_made_from(tmp_path: Path) -> None:
    """The other one is a loop, in whatever order they are; a step that is written again is none."""
    lines, _ = _ring(list(range(16)))
    wrong = f"EDGE_SE2 3 4 5 2 1 {INFORMATION}"
    for mixed in ([wrong, *lines], [*lines, wrong]):
        graph = _chained(tmp_path, mixed)
        assert graph.problem.steps.relative[3, 0] == 1.0
        assert graph.problem.loops.relative[:, 0].max() == 5.0 and len(graph.problem.loops) == 2
    equal, near = [f"VERTEX_SE2 {k} 0 0 0" for k in range(16)], f"EDGE_SE2 3 4 0 0 0 {INFORMATION}"
    graph = _chained(tmp_path, [*equal, *lines[16:], near])  # these are no first guess: the first edge is the step
    assert graph.problem.steps.relative[3, 0] == 1.0
    twice = _chained(tmp_path, [*lines, *lines[16:-1]])
    assert len(twice.problem.loops) == 1 and len(_solved(twice).edges) == 2 * 15 + 1


def test_the_fixed_vertex_stays_and_there_is_one(tmp_path: Path) -> None:
    lines, poses = _ring(list(range(16)))
    solved = _solved(_chained(tmp_path, [*lines, "FIX 9"]))
    assert solved.poses[9].tolist() == poses[9].tolist() and np.abs(solved.poses[0] - poses[0]).max() > 0.01
    with pytest.raises(ValueError, match="FIX holds 2 vertices, 9 first; expected one"):
        _chained(tmp_path, [*lines, "FIX 9", "FIX 3"])
