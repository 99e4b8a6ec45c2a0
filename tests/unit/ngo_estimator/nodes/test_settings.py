"""The estimator nodes' parameters: what is allowed, and the files that list them."""

from dataclasses import fields
from pathlib import Path

import pytest
import yaml

from ngo_common.settings import BadParameter, Settings, described, make_settings
from ngo_estimator.nodes.settings import LocalNodeSettings, MapNodeSettings, NgoNodeSettings
from ngo_estimator.nodes.view_settings import ViewNodeSettings

SRC = Path(__file__).parents[4] / "ros_ws/src"
CONFIG = SRC / "ngo_estimator/config"
KINDS: dict[str, type[Settings]] = {
    "local_node": LocalNodeSettings,
    "ngo_node": NgoNodeSettings,
    "ngo_map": MapNodeSettings,
    "view_node": ViewNodeSettings,
}


@pytest.mark.parametrize("name", KINDS)
def test_the_file_lists_every_parameter_with_its_default_and_description(name: str) -> None:
    text = (CONFIG / f"{name}.yaml").read_text()
    listed = yaml.safe_load(text)[f"/**/{name}"]["ros__parameters"]
    defaults = {entry.name: entry.default for entry in fields(KINDS[name])}
    assert listed == {key: list(value) if isinstance(value, tuple) else value for key, value in defaults.items()}
    assert make_settings(KINDS[name], listed) == KINDS[name]()
    comments = [line.strip().removeprefix("# ") for line in text.splitlines()[1:] if line.strip().startswith("#")]
    assert comments == [described(entry) for entry in fields(KINDS[name])]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"robots": ["red", "red"]}, "list of different names"),
        ({"robots": ["1st"]}, "list of different names"),
        ({"robots": ["red"], "state": "monday"}, "with a state"),
        (
            {"robots": ["red"], "relative_pose_topic": "~/steps"},
            "'relative_pose_topic' is '~/steps'; allowed: a name without ~",
        ),
        ({"robots": ["red"], "trajectory_topic": "~/whole"}, "without ~ in front, with robots"),
    ],
)
def test_robots_have_different_names_topics_in_their_namespaces_and_no_saved_state(
    given: dict[str, object], says: str
) -> None:
    for kind in (NgoNodeSettings, MapNodeSettings):
        with pytest.raises(BadParameter, match=says):
            make_settings(kind, given)


@pytest.mark.parametrize("path", sorted(SRC.glob("*/config/*.yaml")), ids=lambda path: path.name)
def test_every_file_is_accepted_in_any_namespace(path: Path) -> None:
    for name, content in yaml.safe_load(path.read_text()).items():
        assert name.startswith("/**/"), "without, rcl ignores it in a namespace and says nothing"
        if (node := name.removeprefix("/**/")) in KINDS:
            make_settings(KINDS[node], content["ros__parameters"])


def test_frames_that_would_coincide_and_a_short_queue_are_errors() -> None:
    with pytest.raises(BadParameter, match="another name than odom_frame's"):
        LocalNodeSettings(base_frame="odom")
    with pytest.raises(BadParameter, match="another name than odom_frame's"):
        NgoNodeSettings(map_frame="odom")
    with pytest.raises(BadParameter, match="at least window_frames, which is 3000"):
        NgoNodeSettings(window_frames=3000)


def test_a_saved_map_learns_in_localization_alone() -> None:
    with pytest.raises(BadParameter, match="'map_changes' is 'learn'; allowed: ignore, with mode mapping"):
        NgoNodeSettings(map_changes="learn")
    kept, learns = (NgoNodeSettings(mode="localization", state="s", map_changes=value) for value in ("ignore", "learn"))
    assert kept.keeps_map and not learns.keeps_map


def test_a_view_serves_its_page_and_its_data_from_two_ports() -> None:
    with pytest.raises(BadParameter, match="'data_port' is 9090; allowed: another port than web_port"):
        ViewNodeSettings(data_port=9090)


def test_any_world_may_be_named_together_with_its_weights() -> None:
    for world in ("maze2d", "maze3d", "scan", "camera"):
        assert LocalNodeSettings(world=world).world == world
    assert NgoNodeSettings(world="our_robot-2", weights="/weights").world == "our_robot-2"
    assert NgoNodeSettings(world="camera").uses_camera
    assert not NgoNodeSettings(world="camera", weights="/weights").uses_camera  # the name of weights of one's own
    for world, weights in (("our_robot", ""), ("../maze2d", "/weights"), ("", "/weights")):
        with pytest.raises(
            BadParameter, match=f"'world' is '{world}'; allowed: maze2d, maze3d, doom, scan or camera, or"
        ):
            LocalNodeSettings(world=world, weights=weights)


def test_a_localization_needs_a_map() -> None:
    assert NgoNodeSettings(mode="localization", state="office").mode == "localization"
    with pytest.raises(BadParameter, match="parameter 'state' is ''; allowed: the folder of a saved state"):
        NgoNodeSettings(mode="localization")
    with pytest.raises(BadParameter, match="allowed: mapping or localization"):
        NgoNodeSettings(mode="localisation")
