"""The model library in words: the families that suit a problem, and all about one of them."""

from asia.agents.library.pages.page import families_page, family_page

__all__ = ["families_page", "family_page"]
