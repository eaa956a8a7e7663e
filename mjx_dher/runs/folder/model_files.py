"""Files of the models that a custom component's Python file names: MJCF, meshes, height fields, skins and textures."""

import html
import os
import re
from pathlib import Path

_TAG = re.compile(rb"<(\w+)\s((?:[^<>\"']+|\"[^\"]*\"|'[^']*')*)")
_ATTRIBUTE = re.compile(rb"\b(file\w*|meshdir|texturedir|assetdir)\s*=\s*[\"']([^\"'\n]{1,250})[\"']")


def model_files(file: Path) -> list[Path]:
    """MJCF files that a Python file names, files that these include or attach, and their assets, sorted.

    MJCF text in the Python file counts too, with paths relative to its folder. Files that cannot be read are left out.
    """
    code, files, roots = file.read_bytes(), set[Path](), set[Path]()
    waiting = [file, *(model for model in file.parent.glob("*.xml") if os.fsencode(model.name) in code)]
    waiting += [file.parent / os.fsdecode(name) for name in re.findall(rb"[\"']([^\"'\n]{1,250}\.xml)[\"']", code)]
    while waiting:
        root = _normal(waiting.pop())
        if root not in roots:
            roots.add(root)
            own, attached = _files(root)
            files |= own
            waiting += attached
    return sorted(files - {_normal(file)})


def _files(root: Path) -> tuple[set[Path], list[Path]]:
    """Readable files of one model: MJCF files with included ones, and assets. The second value has paths of attached models.

    Asset paths are relative to the root's folder, or to a folder that a `compiler` names. Each such folder is tried, so a file
    may be listed that the model does not load.
    """
    models, attached, assets, folders, waiting = set[Path](), list[Path](), set[str](), {root.parent}, [root]
    while waiting:
        model = _normal(waiting.pop())
        if model in models or not _is_readable(model):
            continue
        models.add(model)
        for tag, attribute, name in _references(model.read_bytes()):
            if attribute.endswith("dir"):
                folders.add(root.parent / name)
            elif tag == "include":  # its path is relative to the root's folder, or to the including file's
                waiting += [root.parent / name, model.parent / name]
            elif tag == "model":
                attached.append(root.parent / name)
            else:
                assets |= {name, os.path.basename(name)}  # the compiler's `strippath` leaves only the base name
    candidates = {_normal(folder / name) for folder in folders for name in assets}
    return models | {path for path in candidates if _is_readable(path)}, attached


def _references(text: bytes) -> list[tuple[str, str, str]]:
    """Tag, attribute and value of each path in MJCF text."""
    return [
        (tag.decode(), attribute.decode(), html.unescape(os.fsdecode(path)).replace("\\", "/"))
        for tag, attributes in _TAG.findall(text)
        for attribute, path in _ATTRIBUTE.findall(attributes)
    ]


def _normal(path: Path) -> Path:
    return Path(os.path.normpath(path))


def _is_readable(path: Path) -> bool:
    return os.path.isfile(path) and os.access(path, os.R_OK)
