// What the 3-D tab draws with: points, lines, triangles, bodies and pictures, by plain WebGL 2.

import {multiply} from "./matrix.js";

const POINTS = `#version 300 es
layout(location = 0) in vec3 at; layout(location = 1) in vec4 tint;
uniform mat4 place; uniform float size, least; out vec4 colour;
void main() { gl_Position = place * vec4(at, 1); gl_PointSize = clamp(size / gl_Position.w, least, 64.0); colour = tint; }`;
// A quad for each line, its half width in pixels: ``size`` at a metre's distance, at least ``least``.
const LINES = `#version 300 es
layout(location = 0) in vec3 at; layout(location = 1) in vec4 tint; layout(location = 2) in vec3 to; layout(location = 3) in vec2 corner;
uniform mat4 place; uniform float size, least; uniform vec2 screen; out vec4 colour;
void main() {
  vec4 a = place * vec4(at, 1), b = place * vec4(to, 1);
  if (a.w < 1e-3 && b.w < 1e-3) { gl_Position = vec4(2, 2, 2, 1); return; }
  if (a.w < 1e-3) a = mix(b, a, (b.w - 1e-3) / (b.w - a.w));
  if (b.w < 1e-3) b = mix(a, b, (a.w - 1e-3) / (a.w - b.w));
  vec2 way = (b.xy / b.w - a.xy / a.w) * screen, side = length(way) > 0.0 ? normalize(vec2(-way.y, way.x)) : vec2(0, 1);
  gl_Position = mix(a, b, corner.x);
  gl_Position.xy += side * corner.y * 2.0 * clamp(size / gl_Position.w, least, 40.0) / screen * gl_Position.w;
  colour = tint;
}`;
// One mesh at many places; its light comes from above and from a side.
const BODIES = `#version 300 es
layout(location = 0) in vec3 at; layout(location = 1) in vec4 tint; layout(location = 2) in vec3 mesh; layout(location = 3) in vec3 normal;
uniform mat4 place, stands; uniform vec3 size; out vec4 colour;
void main() {
  gl_Position = place * vec4(at + mesh * size, 1);
  colour = vec4(tint.rgb * (0.76 + 0.24 * dot(normalize(mat3(stands) * (normal / max(size, 1e-6))), normalize(vec3(0.4, -0.3, 0.87)))), tint.a);
}`;
const COLOUR = `#version 300 es
precision mediump float; in vec4 colour; out vec4 pixel;
void main() { pixel = colour; }`;
const PICTURE = [`#version 300 es
layout(location = 0) in vec2 at; uniform mat4 place; uniform vec2 size; out vec2 where;
void main() { gl_Position = place * vec4(at * size, 0, 1); where = at; }`, `#version 300 es
precision mediump float; in vec2 where; uniform sampler2D picture; out vec4 pixel;
void main() { pixel = texture(picture, where); if (pixel.a < 0.5) discard; }`];

// Positions and normals of triangles, one after the other: a body of side or diameter 1 round its middle.
function ball(rings, parts, shape) {
  const corners = [], put = (ring, part) => corners.push(...shape(Math.PI * ring / rings, 2 * Math.PI * part / parts));
  for (let ring = 0; ring < rings; ring++)
    for (let part = 0; part < parts; part++)
      for (const [down, on] of [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]]) put(ring + down, part + on);
  return new Float32Array(corners);
}
const sphere = (lift, turn) => {
  const normal = [Math.sin(lift) * Math.cos(turn), Math.sin(lift) * Math.sin(turn), Math.cos(lift)];
  return [...normal.map(part => part / 2), ...normal];
};
// Three bands: the lid, the wall, the floor.
const cylinder = (lift, turn) => {
  const ring = Math.round(lift / Math.PI * 3), [x, y] = [Math.cos(turn) / 2, Math.sin(turn) / 2], far = ring % 3 ? 1 : 0;
  return [x * far, y * far, ring < 2 ? 0.5 : -0.5, 2 * x, 2 * y, ring < 2 ? 0.7 : -0.7];
};
function cube() {
  const corners = [];
  for (const axis of [0, 1, 2])
    for (const side of [-0.5, 0.5])
      for (const [u, v] of [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]]) {
        const at = [0, 0, 0], normal = [0, 0, 0];
        [at[axis], at[(axis + 1) % 3], at[(axis + 2) % 3], normal[axis]] = [side, u - 0.5, v - 0.5, 2 * side];
        corners.push(...at, ...normal);
      }
  return new Float32Array(corners);
}

export class Scene {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", {alpha: false});
    if (!gl) throw new Error("This browser has no WebGL 2.");
    this.canvas = canvas;
    this.gl = gl;
    this.lost = false;
    canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); this.lost = true; });
    this.points = this.program(POINTS, COLOUR);
    this.lines = this.program(LINES, COLOUR);
    this.bodies = this.program(BODIES, COLOUR);
    this.pictures = this.program(PICTURE[0], PICTURE[1]);
    this.corners = this.buffer(new Float32Array([0, -1, 0, 1, 1, -1, 1, 1]));
    this.square = this.buffer(new Float32Array([0, 0, 1, 0, 0, 1, 1, 1]));
    this.meshes = Object.fromEntries(Object.entries({cube: cube(), sphere: ball(8, 14, sphere), cylinder: ball(3, 18, cylinder)})
      .map(([name, data]) => [name, {data: this.buffer(data), count: data.length / 6}]));
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.BLEND);
  }

  program(vertices, pixels) {
    const {gl} = this, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertices], [gl.FRAGMENT_SHADER, pixels]]) {
      const shader = gl.createShader(Number(kind));
      gl.shaderSource(shader, String(text));
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(program));
    const names = ["place", "stands", "size", "least", "screen"].map(name => [name, gl.getUniformLocation(program, name)]);
    return {program, at: Object.fromEntries(names)};
  }

  buffer(data) {
    const {gl} = this, buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return buffer;
  }

  // Places and colours on the graphics card; ``free`` takes them off it.
  upload(places, colours) { return {places: this.buffer(places), colours: this.buffer(colours), count: places.length / 3}; }

  free(item) {
    for (const buffer of [item.places, item.colours]) this.gl.deleteBuffer(buffer);
    if (item.texture) this.gl.deleteTexture(item.texture);
  }

  // On ``paper`` [red, green, blue]; a metre at a metre's distance is ``zoom`` of the canvas's height.
  begin(paper, camera, zoom) {
    const {gl, canvas} = this, ratio = Math.min(2, devicePixelRatio || 1), [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio].map(Math.round);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width, height});
    this.camera = camera;
    this.zoom = zoom * height;
    this.ratio = ratio;
    gl.viewport(0, 0, width, height);
    gl.clearColor(paper[0] / 255, paper[1] / 255, paper[2] / 255, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  use({program, at}, model, size = 0, least = 1) {
    const {gl} = this;
    gl.useProgram(program);
    for (let k = 0; k < 4; k++) {
      gl.disableVertexAttribArray(k);
      gl.vertexAttribDivisor(k, 0);
    }
    gl.uniformMatrix4fv(at.place, false, multiply(this.camera, model));
    gl.uniform1f(at.least, least * this.ratio);
    if (typeof size === "number") gl.uniform1f(at.size, size * this.zoom);
    return at;
  }

  attribute(number, buffer, parts, {bytes = 0, from = 0, each = 0, isByte = false} = {}) {
    const {gl} = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(number);
    gl.vertexAttribPointer(number, parts, isByte ? gl.UNSIGNED_BYTE : gl.FLOAT, isByte, bytes, from);
    gl.vertexAttribDivisor(number, each);
  }

  // ``size`` is in metres, ``least`` in pixels.
  drawPoints(item, model, size, least) {
    const {gl} = this;
    this.use(this.points, model, size, least);
    this.attribute(0, item.places, 3);
    this.attribute(1, item.colours, 4, {isByte: true});
    gl.drawArrays(gl.POINTS, 0, item.count);
  }

  drawTriangles(item, model) {
    this.use(this.points, model);
    this.attribute(0, item.places, 3);
    this.attribute(1, item.colours, 4, {isByte: true});
    this.gl.drawArrays(this.gl.TRIANGLES, 0, item.count - item.count % 3);
  }

  // Through all points one after the other, or between each two of them.
  drawLines(item, model, isStrip, size = 0, least = 0.75) {
    const {gl} = this, at = this.use(this.lines, model, size / 2, least), step = isStrip ? 1 : 2, count = isStrip ? item.count - 1 : Math.floor(item.count / 2);
    if (count < 1) return;
    gl.uniform2f(at.screen, this.canvas.width, this.canvas.height);
    this.attribute(0, item.places, 3, {bytes: 12 * step, each: 1});
    this.attribute(1, item.colours, 4, {bytes: 4 * step, each: 1, isByte: true});
    this.attribute(2, item.places, 3, {bytes: 12 * step, from: 12, each: 1});
    this.attribute(3, this.corners, 2);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  }

  // One of ``meshes`` at each place, as large as ``size`` [x, y, z].
  drawBodies(name, item, model, size) {
    const {gl} = this, {data, count} = this.meshes[name], at = this.use(this.bodies, model, size);
    gl.uniformMatrix4fv(at.stands, false, model);
    gl.uniform3f(at.size, size[0], size[1], size[2]);
    this.attribute(0, item.places, 3, {each: 1});
    this.attribute(1, item.colours, 4, {each: 1, isByte: true});
    this.attribute(2, data, 3, {bytes: 24});
    this.attribute(3, data, 3, {bytes: 24, from: 12});
    gl.drawArraysInstanced(gl.TRIANGLES, 0, count, item.count);
  }

  texture(image) {
    const {gl} = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    return texture;
  }

  // A picture that lies on the ground, from the origin to ``size`` [x, y] metres.
  drawPicture(texture, model, size) {
    const {gl} = this, at = this.use(this.pictures, model, size);
    gl.uniform2f(at.size, size[0], size[1]);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    this.attribute(0, this.square, 2);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
}
