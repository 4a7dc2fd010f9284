// The page's address says what it shows: #/robot/NAME/TAB. So back, forward, reload and a link to a colleague work.

export const TABS = ["overview", "cameras", "3d", "health"];

export const address = (name, tab = TABS[0]) => name === null ? "#/" : `#/robot/${encodeURIComponent(name)}/${tab}`;

// The robot and the tab of an address; the robot is null where it names none.
export function route(hash = location.hash) {
  const [, name, tab] = /^#\/robot\/([^/]+)(?:\/([^/]*))?$/.exec(hash) ?? [];
  try {
    return {name: name === undefined ? null : decodeURIComponent(name), tab: TABS.includes(tab) ? tab : TABS[0]};
  } catch {
    return {name: null, tab: TABS[0]};              // no encoding of a name
  }
}

// Show this without a step for back to return to.
export function replace(name, tab) { history.replaceState(null, "", address(name, tab)); }
