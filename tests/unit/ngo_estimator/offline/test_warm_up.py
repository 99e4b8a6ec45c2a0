"""What a lidar's nodes compile before the first scan comes."""

from ngo_estimator.geometry import branch_and_bound, scan_matching, scan_points
from ngo_estimator.offline.warm_up import warm_up


def test_registration_and_the_search_for_loops_are_compiled() -> None:
    warm_up()
    for function in (scan_points._thinned, scan_points._normals, scan_matching._icp, branch_and_bound._best_first):
        assert function.signatures, function
