// Keys that act wherever the focus is: X stops, W A S D and the arrows drive, Escape ends. They go by a key's place on the keyboard, whatever
// letter a layout has there, and no select, slider or button takes them.

const TEXT = "textarea, input:not([type=checkbox], [type=radio], [type=range], [type=button], [type=submit], [type=reset], [type=color], [type=file])";
const ARROWED = "#map, #space, #list, dialog, option";  // arrows have a use of their own there

const isText = target => target instanceof HTMLElement && (target.matches(TEXT) || target.isContentEditable);

// A stop also by the letter itself: on a layout that has its X elsewhere, either key stops.
const stops = event => event.code === "KeyX" || event.key === "x" || event.key === "X";

// on: {stop(), escape()}
export function listen($, drive, on) {
  addEventListener("keydown", event => {
    const {target, code} = event;
    if (code === "Escape") return on.escape();
    if (event.ctrlKey || event.altKey || event.metaKey) return drive.release();  // the end of a key under Meta is not told
    if (isText(target)) return;
    const isArrowed = code.startsWith("Arrow") && target instanceof Element && target.closest(ARROWED) !== null;
    if (stops(event)) {
      if (!event.repeat) on.stop();
    } else if (isArrowed || !drive.press(code, event.repeat)) return;
    event.preventDefault();
    event.stopPropagation();
  }, true);
  addEventListener("keyup", event => drive.lift(event.code), true);
  addEventListener("focusin", event => { if (isText(event.target)) drive.release(); });
  addEventListener("change", event => {             // a select that was used gives the focus back
    if (!(event.target instanceof HTMLSelectElement)) return;
    if (drive.isOpen) drive.pad.focus();
    else event.target.blur();
  });
  label($);
}

// The page names keys as they are printed here, where the browser tells.
async function label($) {
  const {keyboard} = /** @type {any} */ (navigator), layout = await keyboard?.getLayoutMap?.().catch(() => null);
  if (!layout) return;
  const [x, ...driving] = ["KeyX", "KeyW", "KeyA", "KeyS", "KeyD"].map(code => (layout.get(code) ?? code.slice(3)).toUpperCase());
  $("stop").dataset.key = x;
  $("stop").title = `Key: ${x}`;
  $("pad").ariaLabel = `Hold to drive: up is ahead; or the arrows, or ${driving.join(" ")}`;
}
