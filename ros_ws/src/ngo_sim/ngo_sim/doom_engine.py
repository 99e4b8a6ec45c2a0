"""ViZDoom's process: the one place that starts, steps and ends it."""

from __future__ import annotations

import math
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import vizdoom
from numpy.typing import NDArray
from vizdoom import Button, GameVariable, ScreenResolution

from ngo_sim.doom_map import UNITS_PER_M
from ngo_sim.doom_wad import Lump, read_wad, write_lumps
from ngo_sim.doom_walls import walls_at

SHIPPED = Path(vizdoom.__file__).parent  # Where ViZDoom keeps the two games of freedoom, and below it its scenarios.

MAZE_GAME = SHIPPED / "freedoom2.wad"  # The game that the mazes take their textures from.

# Of the fixed list of sizes that ViZDoom renders those of 4:3, to which alone the camera model applies.
RESOLUTIONS = {
    (80, 60): ScreenResolution.RES_160X120,
    (160, 120): ScreenResolution.RES_320X240,
    (200, 150): ScreenResolution.RES_400X300,
    (256, 192): ScreenResolution.RES_512X384,
    (320, 240): ScreenResolution.RES_640X480,
}
"""What is rendered for an observation of this width and height: twice as many pixels each way."""

# A new map ignores input for 7 tics, and its field of view changes by 7 degrees a tic at most.
_SETTLING_TICS = 20
_ENGINE_SEED = 1
_REHEARSED_STEPS = 35
_REHEARSAL_S = 60.0
_WORKING_DIRECTORY_LOCK = threading.Lock()


class DoomEngine:
    """ViZDoom's process.

    width, height: of an observation, one of RESOLUTIONS; what is rendered is twice as large. tics: in a step.
    tells_walls: whether ``walls`` is to be asked, which costs time in each step.
    """

    def __init__(self, width: int, height: int, field_of_view_deg: int, tics: int, tells_walls: bool = False) -> None:
        self._resolution = RESOLUTIONS[width, height]
        self._field_of_view_deg, self._tics, self._tells_walls = field_of_view_deg, tics, tells_walls
        self._game: vizdoom.DoomGame | None = None
        self._harmless = False

    @property
    def running(self) -> bool:
        return self._game is not None

    def start(
        self,
        lumps: Sequence[Lump],
        first_map: str,
        game_wad: Path = MAZE_GAME,
        harmless: bool = False,
        rehearse: bool = False,
    ) -> None:
        """Start the process anew with the maps in these lumps; `game_wad` has the textures.

        harmless: no monsters, no harm to the player, and doors open to the player that stands still before them.
        rehearse: first in a process of its own, because a bad map ends the engine and the process that has started it.
        Raises ValueError where that one dies.
        """
        self.close()
        if rehearse:
            _rehearse(lumps, first_map, game_wad)
        self._harmless = harmless
        # The running process keeps its files open and needs their names no more: nothing is left of a killed one.
        with tempfile.TemporaryDirectory(prefix="ngo_maze3d_", ignore_cleanup_errors=True) as folder:
            self._game = self._started(Path(folder), lumps, first_map, game_wad)

    def _started(self, folder: Path, lumps: Sequence[Lump], first_map: str, game_wad: Path) -> vizdoom.DoomGame:
        """The process, started with its files in ``folder``."""
        write_lumps(folder / "maps.wad", lumps)
        game = vizdoom.DoomGame()
        game.set_vizdoom_path(str(_launcher(folder)))
        game.set_doom_game_path(str(game_wad))
        game.set_doom_scenario_path(str(folder / "maps.wad"))
        game.set_doom_config_path(os.devnull)
        game.set_doom_map(first_map)
        game.set_screen_resolution(self._resolution)
        game.set_screen_format(vizdoom.ScreenFormat.RGB24)
        for part in ("hud", "minimal_hud", "crosshair", "weapon", "decals", "particles", "effects_sprites",
                     "messages", "corpses", "screen_flashes"):  # fmt: skip
            getattr(game, f"set_render_{part}")(False)
        game.set_window_visible(False)
        game.set_sound_enabled(False)
        game.set_console_enabled(False)
        game.set_mode(vizdoom.Mode.PLAYER)
        game.set_episode_timeout(0)
        game.set_seed(_ENGINE_SEED)
        game.set_available_buttons([Button.MOVE_FORWARD_BACKWARD_DELTA, Button.TURN_LEFT_RIGHT_DELTA, Button.USE])
        game.set_available_game_variables([GameVariable.POSITION_X, GameVariable.POSITION_Y, GameVariable.ANGLE])
        game.set_sectors_info_enabled(self._tells_walls)
        # The camera of a walking player goes up and down by default.
        game.set_game_args("+movebob 0 +stillbob 0" + (" -nomonsters" if self._harmless else ""))
        with _WORKING_DIRECTORY_LOCK:
            # The process makes a folder in its working directory, which it can only inherit.
            caller = os.open(".", os.O_RDONLY)
            try:
                os.chdir(folder)
                game.init()
            finally:
                os.fchdir(caller)
                os.close(caller)
        return game

    def enter(self, map_name: str) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """Begin a map; return the first picture and pose, as advance() does."""
        assert self._game is not None
        self._game.set_doom_map(map_name)
        self._game.new_episode()
        # Each map begins with the default field of view: the argument `+fov` holds for the first one alone.
        self._game.send_game_command(f"fov {self._field_of_view_deg}")
        if self._harmless:  # every episode begins without
            self._game.send_game_command("god")
        observed = self._act([0, 0, 0], _SETTLING_TICS)
        wanted, given = self._field_of_view_deg, self._game.get_game_variable(GameVariable.CAMERA_FOV)
        if given != wanted:
            raise RuntimeError(f"the engine's field of view is {given}, not {wanted} degrees")
        return observed

    def advance(self, thrust: int, turn_deg: float, use: bool = False) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """Let a step pass; return the picture (2 height, 2 width, 3) and the pose (3,) at its end.

        use: open the door ahead; counts where the step before was without.
        """
        # The engine turns clockwise for a positive number, and by that number in each tic.
        return self._act([thrust, -turn_deg / self._tics, use], self._tics)

    def walls(self) -> NDArray[np.float64]:
        """The walls at the height of the eye, ``(n, 4)`` as of ``walls_at``, doors and lifts as they are now."""
        assert self._game is not None
        sectors = self._game.get_state().sectors
        assert sectors is not None
        return walls_at(sectors, self._game.get_game_variable(GameVariable.CAMERA_POSITION_Z))

    def _act(self, buttons: list[float], tics: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        assert self._game is not None
        try:
            self._game.make_action(buttons, tics)
        except (vizdoom.ViZDoomErrorException, vizdoom.ViZDoomUnexpectedExitException) as error:
            self.close()
            raise RuntimeError(f"the engine has ended: {error}") from error
        if self._game.is_episode_finished():
            self.close()
            raise RuntimeError("the map has ended the episode by itself")
        state = self._game.get_state()
        assert state.game_variables is not None
        x, y, angle_deg = state.game_variables
        yaw = math.remainder(math.radians(angle_deg), math.tau)
        return state.screen_buffer, np.array([x / UNITS_PER_M, y / UNITS_PER_M, yaw])

    def close(self) -> None:
        """End the process."""
        game, self._game = self._game, None
        if game is not None:
            game.close()


def _launcher(folder: Path) -> Path:
    """What starts the engine: a script in the folder by which the engine ends with this process, even a killed one.

    Without util-linux's setpriv (not on Linux) it is the engine itself.
    """
    engine, setpriv = SHIPPED / "vizdoom", shutil.which("setpriv")
    if setpriv is None:
        return engine
    script = folder / "engine.sh"
    script.write_text(f'#!/bin/sh\nexec {shlex.quote(setpriv)} --pdeathsig KILL -- {shlex.quote(str(engine))} "$@"\n')
    script.chmod(0o700)
    return script


def _rehearse(lumps: Sequence[Lump], first_map: str, game_wad: Path) -> None:
    """Have a process of its own start the engine and walk; raises ValueError where it does not come back well."""
    with tempfile.TemporaryDirectory(prefix="ngo_maze3d_", ignore_cleanup_errors=True) as folder:
        write_lumps(Path(folder, "maps.wad"), lumps)
        command = [sys.executable, "-m", __name__, str(Path(folder, "maps.wad")), first_map, str(game_wad)]
        try:
            done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_REHEARSAL_S)
        except subprocess.TimeoutExpired:
            raise ValueError(f"map is {first_map!r}, with which the engine hangs") from None
    if done.returncode:
        line = done.stderr.strip().splitlines()[-1] if done.returncode > 0 and done.stderr.strip() else "it dies"
        raise ValueError(f"map is {first_map!r}, which is damaged: the engine cannot run it ({line})")


def _walk(wad: Path, name: str, game_wad: Path) -> None:
    """Start the engine with a map and walk; what a bad map does to the engine happens in this process."""
    engine = DoomEngine(*min(RESOLUTIONS), 90, 2)
    engine.start(read_wad(wad).lumps, name, game_wad, harmless=True)
    engine.enter(name)
    for step in range(_REHEARSED_STEPS):
        engine.advance(25, 10.0, use=step % 8 == 0)
    engine.close()


if __name__ == "__main__":
    _walk(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
