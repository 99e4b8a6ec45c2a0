"""Both estimators, with what is shipped, make of each stored drive what they made of it when it was measured.

Settings or weights that are broken or changed fail here, and so does a change of the estimators that changes their
results by more than the rounding of their input does. ``tests.golden.noise_floor`` measures anew.
"""

import pytest

from tests.golden.net import scores_of
from tests.golden.noise_floor import floors, load, paths, stored_names


@pytest.mark.parametrize("name", stored_names())
def test_a_stored_drive_stays_within_the_noise_floor(name: str) -> None:
    drive = load(name)
    run = drive.run()
    assert run.loops > 0
    assert floors()[name].left_by(scores_of(run, drive.true_poses, paths()[name])) == {}


def test_each_stored_drive_was_measured() -> None:
    assert stored_names() == sorted(floors()) == sorted(paths())
