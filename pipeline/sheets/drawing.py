"""Pages of a PDF in millimetres from the upper left corner, y down."""

import io

import numpy as np
from reportlab.pdfgen.canvas import Canvas

from robcal.transforms import Array

_POINT = 72.0 / 25.4
"""Points of a PDF in a millimetre."""
_RULER = 100.0
RULER_HEIGHT = 9.0
"""mm at the bottom of each page for the ruler and the line of text."""


class Sheet:
    """A PDF that is being drawn; one page after the other, all of one size."""

    def __init__(self, page_mm: tuple[float, float], margin_mm: float, title: str) -> None:
        self.page, self.margin, self.title = page_mm, margin_mm, title
        self._stream = io.BytesIO()
        # invariant: the same input gives the same bytes
        self._canvas = Canvas(self._stream, pagesize=(page_mm[0] * _POINT, page_mm[1] * _POINT), invariant=True)
        self._canvas.setTitle(title)
        self._pages = 0

    @property
    def room(self) -> tuple[float, float]:
        """Width and height in mm that targets may take."""
        return self.page[0] - 2 * self.margin, self.page[1] - 2 * self.margin - RULER_HEIGHT

    def _xy(self, x: float, y: float) -> tuple[float, float]:
        return x * _POINT, (self.page[1] - y) * _POINT

    def boxes(self, boxes: Array, grey: float = 0.0) -> None:
        """Rectangles (n, 4) left, top, right, bottom, filled as one path: none shows a seam to its neighbour."""
        path = self._canvas.beginPath()
        for x0, y0, x1, y1 in boxes:
            x, y = self._xy(x0, y1)
            path.rect(x, y, (x1 - x0) * _POINT, (y1 - y0) * _POINT)
        self._canvas.setFillGray(grey)
        self._canvas.drawPath(path, stroke=0, fill=1)

    def discs(self, discs: Array, grey: float = 0.0) -> None:
        """Discs (n, 3) centre and radius."""
        self._canvas.setFillGray(grey)
        for x, y, radius in discs:
            self._canvas.circle(*self._xy(x, y), radius * _POINT, stroke=0, fill=1)

    def sector(
        self, centre: tuple[float, float], radii: tuple[float, float], angles: tuple[float, float], grey: float
    ) -> None:
        """Part of an annulus; ``angles`` in rad clockwise from the top."""
        a = np.linspace(*angles, 2 + int(np.ceil((angles[1] - angles[0]) / np.radians(0.5))))
        outline = [(r * np.sin(t), -r * np.cos(t)) for r, turn in zip(radii, (a, a[::-1]), strict=True) for t in turn]
        path = self._canvas.beginPath()
        for k, (x, y) in enumerate(outline):
            place = self._xy(centre[0] + x, centre[1] + y)
            (path.lineTo if k else path.moveTo)(*place)
        path.close()
        self._canvas.setFillGray(grey)
        self._canvas.drawPath(path, stroke=0, fill=1)

    def text(
        self, x: float, y: float, words: str, height: float = 2.2, grey: float = 0.45, centred: bool = False
    ) -> None:
        """A line of text, its base line at (x, y)."""
        self._canvas.setFillGray(grey)
        self._canvas.setFont("Helvetica", height * _POINT)
        draw = self._canvas.drawCentredString if centred else self._canvas.drawString
        draw(*self._xy(x, y), words)

    def end_page(self) -> None:
        """Ruler and title at the bottom; the next page begins."""
        self._pages += 1
        y = self.page[1] - self.margin
        length = _RULER if self.page[0] - 2 * self.margin >= _RULER + 5 else 50.0
        canvas = self._canvas
        canvas.setStrokeGray(0.0)
        canvas.setLineWidth(0.15 * _POINT)
        canvas.line(*self._xy(self.margin, y - 5), *self._xy(self.margin + length, y - 5))
        for k in range(int(length / 10) + 1):
            tick = 2.5 if k % 5 == 0 else 1.5
            canvas.line(*self._xy(self.margin + 10 * k, y - 5), *self._xy(self.margin + 10 * k, y - 5 - tick))
        message = (
            f"{length:g} mm: measure it; print at 100 %, without fitting to the page.  {self.title}, page {self._pages}"
        )
        self.text(self.margin, y - 1.5, message, 2.0)
        canvas.showPage()

    def content(self) -> bytes:
        """The file."""
        self._canvas.save()
        return self._stream.getvalue()
