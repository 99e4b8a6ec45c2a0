"""README and docs name only what exists: files, modules, options, parameters, tests, make targets."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = {
    **{name: ROOT / "ros_ws/src" / name / name for name in ("ngo_estimator", "ngo_recordings", "ngo_sim")},
    **{name: ROOT / name for name in ("benchmarks", "demo", "tests", "training")},
}
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
README_LINES = 150

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def links(text: str) -> list[str]:
    """Targets of links and images within the repository."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    return [target for target in re.findall(r"\]\(([^)\s]+)\)", prose) if not re.match(r"\w+:", target)]


def anchors(text: str) -> set[str]:
    """Names that links use for the headings of a page."""
    titles = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def commands(text: str) -> list[str]:
    """Lines of blocks of shell commands, with continued lines joined and comments removed."""
    blocks = re.findall(r"```bash\n(.*?)```", text, re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [re.sub(r"\s+#.*", "", line) for line in lines]


def source_of(module: str) -> Path | None:
    """File or folder of a dotted module; None where there is none."""
    package, *parts = module.split(".")
    path = SOURCES[package].joinpath(*parts)
    return next((found for found in (path.with_suffix(".py"), path) if found.exists()), None)


@cache
def fields() -> dict[str, set[str]]:
    """Annotated fields of every class of the training and of the recordings, and the names that the class refers to."""
    found: dict[str, set[str]] = {}
    for package in ("training", "ngo_recordings", "ngo_estimator", "benchmarks"):
        for path in SOURCES[package].rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    key = f"{path}:{node.name}" if node.name == "Arguments" else node.name
                    inner = [item for item in node.body if isinstance(item, ast.AnnAssign)]
                    found[key] = {item.target.id for item in inner if isinstance(item.target, ast.Name)}
                    parents = [*node.bases, *(item.annotation for item in inner)]
                    names = [name for parent in parents for name in ast.walk(parent)]
                    found[key] |= {f"<{name.id}>" for name in names if isinstance(name, ast.Name)}
                    found[key] |= {f"<{name.attr}>" for name in names if isinstance(name, ast.Attribute)}
    return found


@cache
def options(path: Path) -> set[str]:
    """Options of a script: argparse's, or the fields of its dataclass and of the dataclasses in it."""
    known, todo, seen = set(), [f"{path}:Arguments"], set()
    while todo:
        key = todo.pop()
        for name in fields().get(key, set()) - seen:
            seen.add(name)
            known.add(name)
            todo.append(name.strip("<>"))
    written = re.findall(r'add_argument\(\s*"--([\w-]+)"', path.read_text(encoding="utf-8"))
    return {name.replace("_", "-") for name in known} | set(written) | {"help"}


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= README_LINES


@pages
def test_links_and_images_lead_somewhere(page: Path) -> None:
    missing = []
    for target in links(page.read_text(encoding="utf-8")):
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        if not file.exists() or (anchor and anchor not in anchors(file.read_text(encoding="utf-8"))):
            missing.append(target)
    assert missing == []


def test_every_image_is_shown() -> None:
    shown = {(page.parent / target).resolve() for page in PAGES for target in links(page.read_text(encoding="utf-8"))}
    assert [path.name for path in sorted((ROOT / "docs/images").iterdir()) if path not in shown] == []


def test_every_page_of_docs_is_in_the_index() -> None:
    index = ROOT / "docs/README.md"
    listed = {
        (index.parent / target.partition("#")[0]).resolve() for target in links(index.read_text(encoding="utf-8"))
    }
    assert [str(page) for page in PAGES if page.is_relative_to(index.parent) and page not in {index, *listed}] == []


@pages
def test_modules_and_files_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    modules = set(re.findall(rf"\b((?:{'|'.join(SOURCES)})(?:\.[a-z]\w*)+)", text))
    missing = [name for name in modules if not name.endswith(".py") and source_of(name) is None]
    files = [str(path) for folder in SOURCES.values() for path in folder.rglob("*.py")]
    named = re.findall(r"`(\w+/[\w/]+\.py)`", text)
    missing += [name for name in named if not any(file.endswith(f"/{name}") for file in files)]
    assert missing == []


@pages
def test_commands_are_right(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    parameters = (ROOT / "docs/reference/parameters.md").read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    wrong = []
    for command in [*commands(text), *re.findall(r"`((?:python|make|ros2) [^`]+)`", text)]:
        script = re.match(
            r"python -m (\w[\w.]+)|python ([\w/]+)\.py|"
            r"ros2 run ngo_estimator (run_recording|optimize_graph|join_sessions)",
            command,
        )
        if script:
            module = script[1] or (script[2] or "").replace("/", ".") or f"ngo_estimator.nodes.{script[3]}"
            if task := re.match(r"python -m training\.train ([a-z_]+)", command):
                module = f"training.train_{task[1]}"
            source = source_of(module)
            flags = re.findall(r"\s--([a-z][\w-]*)", command) if source else []
            wrong += [f"{command}: {flag}" for flag in flags if flag.removeprefix("no-") not in options(source)]
        for name in re.findall(r"-p (\w+):=", command):
            wrong += [] if f"| `{name}` |" in parameters else [f"{command}: {name}"]
        if target := re.match(r"make ([a-z]+)", command):
            wrong += [] if re.search(rf"^{target[1]}:", makefile, re.MULTILINE) else [command]
        if launch := re.match(r"ros2 launch (ngo_\w+) ([\w.]+)", command):
            wrong += [] if (ROOT / "ros_ws/src" / launch[1] / "launch" / launch[2]).exists() else [command]
    assert wrong == []


@pages
def test_tests_that_are_named_exist(page: Path) -> None:
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    named = set(re.findall(r"`(test_\w+)`", page.read_text(encoding="utf-8")))
    assert [name for name in named if f"def {name}(" not in tests] == []
