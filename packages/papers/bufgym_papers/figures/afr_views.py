"""Camera views under four motions: three of the AFR paper, and a look aside along a corridor, which is ours.

See packages/papers/bufgym_papers/figures/README.md, "Views under four motions".
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.model import qoi
from bufgym.model.qoi import Value
from bufgym_papers.figures.figure import COLOURS, Figure, legend_below
from bufgym_papers.figures.rows import FigureRows

VIEW_ANGLE = math.radians(60)  # The camera's field of view
MESSAGES = 20  # V is computed for distances 0..``MESSAGES``


@dataclass(frozen=True)
class CameraMotion:
    label: str  # label in the picture
    view: Callable[[float], tuple[float, float]]  # left and right edge of a message's view, given the message's number
    dimensions: int  # 1 if the view has edges in one direction, 2 if it has the same edges in both
    formula: Value  # V in closed form; the paper gives that of the wall

    def new(self, d: float) -> float:
        """Fraction of a view that was not in the view ``d`` messages earlier."""
        (left, right), (from_, until) = self.view(d), self.view(0)
        overlap = max(0.0, min(right, until) - max(left, from_)) / (right - left)
        return 1 - float(overlap**self.dimensions)

    def table(self) -> NDArray[np.float64]:
        """V(0), ..., V(MESSAGES) from the views, float64[MESSAGES + 1]."""
        return np.array([self.new(d) for d in range(MESSAGES + 1)])


def _passing(width: float, step: float) -> tuple[Callable[[float], tuple[float, float]], int, Value]:
    """View, dimensions and V of a motion past a wall: ``step`` a message, a view ``width`` wide."""
    return lambda k: (k * step - width / 2, k * step + width / 2), 1, qoi.saturating(width / step)


@dataclass(frozen=True)
class Forward(CameraMotion):
    """Forward along a corridor; ``view`` is the stretch ahead, from the camera to its range (Fig. 3 (a))."""

    half_m: float  # half the corridor's width

    def area(self, camera_m: float, until_m: float) -> float:
        """Area between the walls that a camera there sees, up to this line across the corridor."""
        walls_m = camera_m + self.half_m / math.tan(VIEW_ANGLE / 2)  # where its view meets them
        edges = np.array([camera_m, min(walls_m, until_m), max(until_m, camera_m)])
        widths = 2 * np.minimum(self.half_m, np.maximum(0.0, edges - camera_m) * math.tan(VIEW_ANGLE / 2))
        return float(np.trapezoid(widths, edges))

    def new(self, d: float) -> float:
        (_, until_m), (camera_m, range_m) = self.view(0), self.view(d)
        # What a camera sees, the one behind it sees as well, up to that one's range.
        return 1 - self.area(camera_m, max(camera_m, until_m)) / self.area(camera_m, range_m)


@dataclass(frozen=True)
class GeometryFigure(Figure):
    """A figure of the four motions."""

    base: float = 0.618  # fraction of a wall's view that was in the previous message's view (Fig. 5 of the paper).
    turn_degrees: float = 7.5  # angle turned between two messages
    step_m: float = 0.15  # distance driven along the corridor between two messages
    range_m: float = 4.0  # how far the camera sees along the corridor, about what a Kinect does
    wall_m: float = 1.5  # distance to the corridor's side wall, and to the other wall at the start

    SIZE_INCHES = (12.0, 3.9)

    def motions(self) -> dict[str, CameraMotion]:
        """Map a column name to its motion."""
        half, width = math.tan(VIEW_ANGLE / 2), 2 * self.wall_m * math.tan(VIEW_ANGLE / 2)
        turn = math.radians(self.turn_degrees)
        walls_m = self.wall_m / half  # from the camera to where its view meets the walls

        def area(depth_m: float) -> float:
            """What lies before the camera and between the walls, up to this depth."""
            return self.wall_m * (2 * depth_m - walls_m) if depth_m > walls_m else max(0.0, depth_m) ** 2 * half

        new = [1 - area(self.range_m - d * self.step_m) / area(self.range_m) for d in range(MESSAGES + 1)]

        def wall(k: float) -> tuple[float, float]:
            edge = half * self.wall_m * self.base ** (-k / 2)
            return -edge, edge

        return {
            "forward": Forward(
                "forward along a corridor",
                lambda k: (k * self.step_m, k * self.step_m + self.range_m),
                2,
                replace(qoi.tabulated(range(MESSAGES + 1), new), name="straight, then bending"),
                self.wall_m,
            ),
            "wall": CameraMotion("moving back from a wall", wall, 2, qoi.exponential(self.base)),
            "turn": CameraMotion("turning in place", *_passing(VIEW_ANGLE, turn)),
            "corridor": CameraMotion("along a corridor, looking at its side", *_passing(width, self.step_m)),
        }

    def simulate(self) -> FigureRows:
        """Return a row for each motion and distance d with V from the views and V from the formula."""
        return FigureRows(
            {"motion": name, "d": d, "V": float(v), "formula": motion.formula(d)}
            for name, motion in self.motions().items()
            for d, v in enumerate(motion.table())
        )

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        # ``tabulated`` refuses a V that breaks one of Eq. 3-6.
        values = [qoi.tabulated(range(MESSAGES + 1), rows.column("V", motion=name).tolist()) for name in self.motions()]
        difference = float(abs(rows.column("V") - rows.column("formula")).max())
        return {"concave": len(values) == len(self.motions()), "formulas": difference < 1e-12}


@dataclass(frozen=True)
class Reproduction(GeometryFigure):
    """Picture of the camera's first views in each motion, seen from above."""

    shown: int = 4  # number of messages drawn

    def draw(self, rows: FigureRows, figure: Any) -> None:
        panels = figure.subplots(1, 4)
        for axes, (name, motion) in zip(panels, self.motions().items(), strict=True):
            for k in range(self.shown):
                left, right = motion.view(k)
                if name == "turn":
                    x, y = [0, math.sin(left), math.sin(right), 0], [0, math.cos(left), math.cos(right), 0]
                elif name == "forward":
                    bend = left + self.wall_m / math.tan(VIEW_ANGLE / 2)
                    x = [0, -self.wall_m, -self.wall_m, self.wall_m, self.wall_m, 0]
                    y = [left, bend, right, right, bend, left]
                    for wall_m in (-self.wall_m, self.wall_m):
                        axes.axvline(wall_m, color=COLOURS["oracle"], linewidth=3)
                else:
                    away = self.wall_m if name == "corridor" else right / math.tan(VIEW_ANGLE / 2)
                    x, y = [left, (left + right) / 2, right], [0, -away, 0]
                    axes.axhline(0, color=COLOURS["oracle"], linewidth=3)
                axes.plot(x, y, color=list(COLOURS.values())[k % 6], linewidth=1.4, label=f"message {k}")
            axes.set_title(motion.label, loc="left", fontsize=10)
            axes.set(aspect="equal", xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
        legend_below(figure, self.shown, panels[0])
