// Names on the map: beside their robots, inside the map, and none over another.

const HEIGHT = 15, EDGE = 3, NEAR = 12, MOST = 120;
const widths = new Map();                           // to measure a text takes long

const apart = (one, other) => one[0] >= other[2] || one[2] <= other[0] || one[1] >= other[3] || one[3] <= other[1];

// Where texts may stand, [left, top, right, bottom] each or null for one without a place; ``items`` are {text, x, y}, the most important first.
export function placed(items, measure, width, height) {
  const marks = items.map(({x, y}) => [x - 9, y - 9, x + 9, y + 9]), taken = [];
  return items.map(({text, x, y}, number) => {
    if (number >= MOST || x < 0 || y < 0 || x > width || y > height) return null;
    if (!widths.has(text)) widths.set(text, measure(text));
    const wide = Math.min(widths.get(text), width - 2 * EDGE), corners = [];
    for (const left of [x + NEAR, x - NEAR - wide, x - wide / 2])
      for (const top of [y - NEAR - HEIGHT + 6, y + NEAR - 6, y - HEIGHT / 2]) corners.push([left, top]);
    corners.splice(-3, 3, [x - wide / 2, y - NEAR - HEIGHT], [x - wide / 2, y + NEAR]);
    const boxes = corners.map(([left, top]) => [left, top, left + wide, top + HEIGHT])
      .filter(box => box[0] >= EDGE && box[1] >= EDGE && box[2] <= width - EDGE && box[3] <= height - EDGE && taken.every(other => apart(box, other)));
    const box = boxes.find(box => marks.every((mark, k) => k === number || apart(box, mark))) ?? (number === 0 ? boxes[0] : undefined);
    if (!box) return null;
    if (widths.size > 5000) widths.clear();
    taken.push(box);
    return box;
  });
}

export const BELOW_TOP = HEIGHT - 3;                // a text's baseline, below its box's top
