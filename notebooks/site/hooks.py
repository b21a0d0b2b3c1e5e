"""What the site has besides the pages of the guide: README and changelog, and the generated reference."""

import re
from pathlib import Path

from mkdocs.structure.files import File
from reference import pages

ROOT = Path(__file__).resolve().parents[2]
TOP = {"README.md": "index.md", "CHANGELOG.md": "changes.md"}


def on_files(files, config):
    """Add the pages that are no files of the folder."""
    texts = {target: (ROOT / name).read_text(encoding="utf-8") for name, target in TOP.items()}
    texts = {target: text.replace("](notebooks/", "](") for target, text in texts.items()}
    for path, text in (texts | pages()).items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Links to the top of the repository lead to those pages."""
    for name, target in TOP.items():
        markdown = re.sub(
            rf"\]\((\.\./)*{re.escape(name)}", f"]({'../' * page.file.src_uri.count('/')}{target}", markdown
        )
    return markdown


def on_post_page(output, page, config):
    """The search has a name for those who do not see it."""
    return output.replace('role="dialog"', 'role="dialog" aria-label="Search"')


def on_post_build(config):
    """No page for a server's missing addresses: the site is opened from the disk."""
    (Path(config.site_dir) / "404.html").unlink()
