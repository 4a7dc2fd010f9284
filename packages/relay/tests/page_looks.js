// How the page looks, as expressions of a browser's test: each of these lists what is wrong.

({
  // Targets of less than 44 px.
  small: () => [...document.querySelectorAll("a[href], button, select, summary, input, [role=button], [tabindex]")]
    .filter(one => one.checkVisibility()).map(one => one.closest("label:has(input)") ?? one)
    .map(one => [one.id || one.className || one.textContent, one.getBoundingClientRect()])
    .filter(([, {width, height}]) => width < 44 || height < 44)
    .map(([name, {width, height}]) => `${name} ${width} x ${height}`),

  // What runs out of its box.
  wide: () => [...document.querySelectorAll("body, main, header, footer, section, figure, .card, .numbers div, #tools, #tabs a")]
    .filter(one => one.checkVisibility() && one.scrollWidth > one.clientWidth && one.clientWidth)
    .map(one => `${one.id || one.className || one.tagName}: ${one.scrollWidth} in ${one.clientWidth}`),

  // What has less contrast than WCAG 2.2 asks for, AA: 4.5, and 3 for large text and what shows a control.
  faint: () => {
    const canvas = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
    const mixed = colours => {
      canvas.clearRect(0, 0, 1, 1);
      for (const colour of colours) { canvas.fillStyle = colour; canvas.fillRect(0, 0, 1, 1); }
      return canvas.getImageData(0, 0, 1, 1).data;
    };
    const part = value => value <= .04045 ? value / 12.92 : ((value + .055) / 1.055) ** 2.4;
    const light = colours => {
      const [red, green, blue] = [...mixed(colours)].map(value => part(value / 255));
      return .2126 * red + .7152 * green + .0722 * blue + .05;
    };
    const ratio = (one, other) => Math.max(light(one) / light(other), light(other) / light(one));
    const below = (one, layers = []) =>
      one ? below(one.parentElement, [getComputedStyle(one).backgroundColor, ...layers]) : layers;
    const found = [];
    for (const one of document.querySelectorAll("body *")) {
      if (!one.checkVisibility({opacityProperty: true}) || one.closest(":disabled, option")) continue;
      const style = getComputedStyle(one), fill = below(one), around = below(one.parentElement);
      const need = (what, has, least) => {
        if (has < least) found.push(`${what} of ${one.id || one.className || one.tagName}: ${has.toFixed(2)}`);
      };
      const least = parseFloat(style.fontSize) >= (style.fontWeight >= 700 ? 18.66 : 24) ? 3 : 4.5;
      const isText = [...one.childNodes].some(node => node.nodeType === Node.TEXT_NODE && node.data.trim());
      if (isText || one.matches("input, select")) need("text", ratio(fill, [...fill, style.color]), least);
      const faint = getComputedStyle(one, "::placeholder").color;
      if (one.placeholder) need("placeholder", ratio(fill, [...fill, faint]), least);
      if (one.matches("input[type=search], button, select"))
        need("edge", Math.max(ratio(around, fill), ratio(around, [...around, style.borderTopColor])), 3);
      if (one.matches(".dot")) need("dot", ratio(around, fill), 3);
    }
    return found;
  },
})
