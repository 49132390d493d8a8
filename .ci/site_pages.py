"""What the site has besides the pages of `docs/`: README as its first page, the changelog, a page
of reference for each package, and the files of the repository that pages link to."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "iga_drake"
_LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(\))")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Adds the pages of reference to the navigation."""
    config.nav = [*config.nav[:-1], {"Reference": [f"reference/{name}.md" for name in _parts()]}]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages and files."""
    pages = {"index.md": ROOT / "README.md", "changelog.md": ROOT / "CHANGELOG.md"}
    linked: set[Path] = set()
    for name, source in pages.items():
        text = _moved(source.read_text(encoding="utf-8"), source.parent, linked)
        files.append(File.generated(config, name, content=text))
    for page in sorted(Path(config.docs_dir).glob("*.md")):
        _moved(page.read_text(encoding="utf-8"), page.parent, linked)
    for path in sorted(linked):
        place = f"repository/{path.relative_to(ROOT).as_posix()}"
        if path.suffix == ".md":  # a card, shown as it is
            place += ".txt"
        files.append(File.generated(config, place, abs_src_path=str(path)))
    for name in _parts():
        text = f"# iga_drake.{name}\n\n::: iga_drake.{name}\n"
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def on_page_markdown(markdown: str, page: object, config: MkDocsConfig, files: Files) -> str:
    """Lets links to files of the repository lead to their copies in the site."""
    return _moved(markdown, Path(config.docs_dir), set())


def on_page_content(html: str, page: object, config: MkDocsConfig, files: Files) -> str:
    """Names the ports of systems in words instead of Drake's directive."""
    return html.replace("<p>.. pydrake_system::</p>", "<p>Ports:</p>")


def _parts() -> list[str]:
    """Packages and public modules of the root, by name."""
    found = [path.parent.name for path in PACKAGE.glob("*/__init__.py")]
    found += [path.stem for path in PACKAGE.glob("[!_]*.py")]
    return sorted(found)


def _moved(text: str, folder: Path, linked: set[Path]) -> str:
    """`text` of a page in `folder` with its links as the site has them; adds the files that they
    lead to outside `docs/` to `linked`."""

    def place(match: re.Match[str]) -> str:
        opening, link, anchor, closing = match.groups()
        path = (folder / link).resolve()
        if not path.is_file():
            return match[0]
        if path == ROOT / "CHANGELOG.md":
            target = "changelog.md"
        elif path == ROOT / "README.md":
            target = "index.md"
        elif path.parent == ROOT / "docs":
            target = path.name
        else:
            linked.add(path)
            target = f"repository/{path.relative_to(ROOT).as_posix()}"
            target += ".txt" if path.suffix == ".md" else ""
        return f"{opening}{target}{anchor or ''}{closing}"

    return _LINK.sub(place, text)
