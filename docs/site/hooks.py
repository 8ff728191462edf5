"""What the site holds beside the pages of docs/: commands, API, and pages of the repository."""

import re
import sys
from posixpath import dirname, join, normpath, relpath

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

sys.path.insert(0, __file__.rsplit("/", 1)[0])

from api import api_page
from commands import commands_page

# Pages that lie outside docs/ in the repository; in the site they keep their path.
OUTSIDE = (
    "SECURITY.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "benchmarks/README.md",
    "benchmarks/RESULTS.md",
)
LINK = re.compile(r"(\]\()(?!https?:|mailto:|#)([^)#\s]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages and those of the repository's other folders."""
    files.append(File.generated(config, "commands.md", content=commands_page()))
    files.append(File.generated(config, "api.md", content=api_page()))
    for name in OUTSIDE:
        path = join(dirname(config.config_file_path), name)
        files.append(File.generated(config, name, abs_src_path=path))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links that are valid in the repository, as links of the site."""
    site_path = page.file.src_uri
    repository_path = site_path if site_path in OUTSIDE else f"docs/{site_path}"

    def mend(link: re.Match[str]) -> str:
        target = normpath(join(dirname(repository_path), link[2]))
        in_site = target.removeprefix("docs/")
        if target == "README.md":
            in_site = "index.md"
        return link[1] + relpath(in_site, dirname(site_path) or ".")

    return LINK.sub(mend, markdown)
