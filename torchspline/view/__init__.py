"""Pages that show motion: one file of HTML each, without anything from the network."""

from torchspline.view.page import page, write_page

__all__ = ["page", "write_page"]
