"""Joins sites of several versions: `python docs/site/versions.py PUBLIC`.

PUBLIC has a folder for each version, such as `PUBLIC/0.2.0`, which `.ci/run --docs PUBLIC/0.2.0` writes. The script writes
`versions.json`, from which every page lists the versions, and copies files that belong at the top from the newest version.
"""

import json
import re
import shutil
import sys
from pathlib import Path

VERSION = re.compile(r"\d+(\.\d+)*|main")


def versions(public: Path) -> list[str]:
    """Names of the folders with a site, the newest release first and `main` last."""
    names = [path.parent.name for path in public.glob("*/objects.inv") if VERSION.fullmatch(path.parent.name)]
    return sorted(names, key=lambda name: [-1] if name == "main" else [*map(int, name.split("."))], reverse=True)


def main(arguments: list[str]) -> None:
    """Writes the files into the folder on the command line."""
    if len(arguments) != 1:
        raise SystemExit(__doc__)
    public = Path(arguments[0])
    names = versions(public)
    if not names:
        raise SystemExit(f"error: {public} has no folder with a site that is named after a version, such as 0.2.0, or main")
    (public / "versions.json").write_text(json.dumps(names) + "\n")
    newest = public / names[0]
    for name in ("404.html", "robots.txt"):
        shutil.copy(newest / name, public / name)
    front = (newest / "index.html").read_text()
    (public / "index.html").write_text(front.replace("docs/index.html", f"{names[0]}/docs/index.html"))
    print(f"{public} has {', '.join(names)}; {public / 'index.html'} leads to {names[0]}")


if __name__ == "__main__":
    main(sys.argv[1:])
