// Robots that are near each other: whoever drives one sees it before they touch.

const MOST_M = 100, USUAL_M = 1;

// The distance below which robots are marked, m; 0 marks none. It is kept in this browser.
export class Near {
  constructor(input) {
    const kept = localStorage.getItem("near");
    this.input = input;
    input.value = kept ?? String(USUAL_M);
    input.onchange = () => localStorage.setItem("near", input.value);
  }

  get m() { return Math.min(MOST_M, Math.max(0, Number(this.input.value) || 0)); }

  // Each robot gets ``near``: the name of the nearest within the distance and in the same frame, and how far that is; or null.
  mark(robots) {
    const {m} = this, placed = robots.filter(robot => robot.pose).sort((one, other) => one.pose.x - other.pose.x);
    for (const robot of robots) robot.near = null;
    placed.forEach((one, k) => {
      for (let j = k + 1; j < placed.length && placed[j].pose.x - one.pose.x < m; j++) {
        const other = placed[j], apart = Math.hypot(one.pose.x - other.pose.x, one.pose.y - other.pose.y);
        if (apart >= m || (one.pose.frame ?? "") !== (other.pose.frame ?? "")) continue;
        if (!(one.near?.m <= apart)) one.near = {name: other.name, m: apart};
        if (!(other.near?.m <= apart)) other.near = {name: one.name, m: apart};
      }
    });
  }
}
