"""Shows docs/joss/paper.md, which cites as Pandoc does, on the site: title, citations and references become Markdown."""

import re

PAPER = "docs/joss/paper"
CITATION = re.compile(r"\[(@\w+(?:; @\w+)*)\]")


def entries(bib: str) -> dict[str, dict[str, str]]:
    """Fields of each entry of a BibTeX file that has a field per line."""
    found = re.findall(r"^@\w+\{(\w+),\n(.*?)^\}", bib, re.M | re.S)
    return {key: {name: plain(text) for name, text in re.findall(r"^ *(\w+) = \{(.*)\},$", body, re.M)} for key, body in found}


def plain(text: str) -> str:
    """A field without TeX."""
    return re.sub(r"[{}]", "", text.replace(r"{\l}", "ł").replace("--", "-"))


def people(author: str) -> list[str]:
    """Family names, or names of groups."""
    return [name.partition(",")[0] for name in author.split(" and ")]


def label(entry: dict[str, str]) -> str:
    """A citation in the text, such as "Raffin et al. 2021"."""
    names = people(entry["author"])
    return " ".join([names[0], *(["et al."] if len(names) > 1 else []), *([entry["year"]] if "year" in entry else ["no year"])])


def reference(entry: dict[str, str]) -> str:
    """A line of the references."""
    names = ", ".join(people(entry["author"])).replace(", others", " et al")
    where = entry.get("journal") or entry.get("booktitle") or entry.get("note") or ""
    address = entry.get("url") or (f"https://doi.org/{entry['doi']}" if "doi" in entry else "")
    title = f"[{entry['title']}]({address})" if address else f"*{entry['title']}*"
    return ". ".join(part for part in (names, title, ", ".join(filter(None, (where, entry.get("year"))))) if part) + "."


def page(text: str, bib: str) -> str:
    """The paper as a page: its title as heading, labels for keys, and the references at the end."""
    known, (_, front, body) = entries(bib), text.split("---\n", 2)
    if missing := sorted(set(re.findall(r"@(\w+)", "".join(CITATION.findall(body)))) - set(known)):
        raise ValueError(f"{PAPER}.md cites {', '.join(missing)}, which the .bib file lacks")
    body = CITATION.sub(lambda keys: "(" + "; ".join(label(known[key[1:]]) for key in keys[1].split("; ")) + ")", body)
    title = re.search(r'^title: "(.*)"$', front, re.M)
    body = re.sub(r"^# ", "## ", body, flags=re.M)
    lines = "".join(f"* {reference(entry)}\n" for entry in known.values())
    return f"# {title[1] if title else 'Paper'}\n{body}\n{lines}"
