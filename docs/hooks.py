"""What mkdocs does besides: pages of the API, the tutorial from its notebook, and links out of docs/."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
OUT = re.compile(r"(!?)\[([^\]]*)\]\(\.\./([^)#]+)(?:#[^)]*)?\)")
ROLE = re.compile(r":\w+:<code>~?([^<]*)</code>")


def on_config(config: Any) -> Any:
    """List a page for each package under "API"."""
    config.nav.append({"API": [f"api/{name}.md" for name in packages()]})
    return config


def packages() -> list[str]:
    """The packages and modules directly below fb3d_rl."""
    found = [path for path in (ROOT / "fb3d_rl").iterdir() if (path / "__init__.py").is_file() or path.suffix == ".py"]
    return sorted(path.stem for path in found if not path.stem.startswith("_"))


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made here, and the pictures of results/."""
    for name in packages():
        text = f"---\ntitle: {name}\n---\n\n::: fb3d_rl.{name}\n"
        files.append(File.generated(config, f"api/{name}.md", content=text))
    notebook = json.loads((ROOT / "docs/tutorial.ipynb").read_text())
    files.append(File.generated(config, "tutorial.md", content=tutorial(notebook)))
    for picture in sorted((ROOT / "results").glob("**/*.png")):
        if "runs" not in picture.parts:
            name = picture.relative_to(ROOT).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(picture)))
    return files


def tutorial(notebook: dict[str, Any]) -> str:
    """A notebook's cells as Markdown."""
    cells = [(cell["cell_type"], "".join(cell["source"])) for cell in notebook["cells"]]
    return "\n\n".join(f"```python\n{text}\n```" if kind == "code" else text for kind, text in cells) + "\n"


def on_page_markdown(markdown: str, config: Any, **_: Any) -> str:
    """Links to files beside docs/: pictures are copied, others lead to the repository, if mkdocs.yml names it."""

    def link(found: re.Match[str]) -> str:
        picture, text, path = found.groups()
        if picture:
            return f"![{text}]({path})"
        return f"[{text}]({config.repo_url}/blob/main/{path})" if config.repo_url else text

    return OUT.sub(link, markdown).replace("tutorial.ipynb", "tutorial.md")


def on_page_content(html: str, **_: Any) -> str:
    """Sphinx's roles in docstrings, ``:func:`~package.name```, as code."""
    return ROLE.sub(lambda found: f"<code>{found[1].rpartition('.')[2]}</code>", html)
