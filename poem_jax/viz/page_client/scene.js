"use strict";
/* The drawing by WebGL 2: hands, pictures in the room or behind the hands, frames of cameras, a grid below. */

const MESH_VERTEX = `#version 300 es
uniform mat4 clip;
in vec3 position, normal, rgb;
out vec3 at, up, colour;
void main() { at = position; up = normal; colour = rgb; gl_Position = clip * vec4(position, 1.0); }`;
const MESH_FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 eye;
uniform float opacity;
in vec3 at, up, colour;
out vec4 shown;
void main() {
  float facing = abs(dot(normalize(up), normalize(eye - at)));
  float light = 0.30 + 0.70 * facing + 0.12 * pow(facing, 12.0);
  shown = vec4(min(colour * light, 1.0), 1.0) * opacity;
}`;
const PICTURE_VERTEX = `#version 300 es
uniform mat4 clip;
in vec3 position;
in vec2 place;
out vec2 at;
void main() { at = place; gl_Position = clip * vec4(position, 1.0); }`;
const PICTURE_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D picture;
in vec2 at;
out vec4 shown;
void main() { shown = vec4(texture(picture, at).rgb, 1.0); }`;
const LINE_VERTEX = `#version 300 es
uniform mat4 clip;
in vec3 position;
void main() { gl_Position = clip * vec4(position, 1.0); }`;
const LINE_FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 rgb;
out vec4 shown;
void main() { shown = vec4(rgb, 1.0); }`;
const CORNERS = [[0, 0], [1, 0], [1, 1], [0, 1]];

class Scene {
  /* `lines`: world points by name, two a line. `quads`: the corners of each camera's picture in the room. */
  constructor(canvas, lines, quads) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!this.gl) return;
    const gl = this.gl;
    this.programs = {
      mesh: compiled(gl, MESH_VERTEX, MESH_FRAGMENT),
      picture: compiled(gl, PICTURE_VERTEX, PICTURE_FRAGMENT),
      line: compiled(gl, LINE_VERTEX, LINE_FRAGMENT),
    };
    this.lines = {};
    for (const [name, points] of Object.entries(lines))
      this.lines[name] = { count: points.length, parts: this.arraysOf("line", { position: [points.flat(), 3] }) };
    this.quads = quads.map((corners) => this.quad(corners));
    this.pictures = quads.map(() => ({ texture: gl.createTexture(), bitmap: null }));
    this.meshes = [];
  }

  get works() { return this.gl !== null; }

  arraysOf(program, fields, indices = null) {
    const gl = this.gl, array = gl.createVertexArray(), buffers = [];
    gl.bindVertexArray(array);
    const fill = (target, data) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(target, buffer);
      gl.bufferData(target, data, gl.STATIC_DRAW);
      buffers.push(buffer);
    };
    for (const [name, [values, size]] of Object.entries(fields)) {
      fill(gl.ARRAY_BUFFER, values instanceof Float32Array ? values : new Float32Array(values));
      const place = gl.getAttribLocation(this.programs[program].program, name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
    }
    if (indices) fill(gl.ELEMENT_ARRAY_BUFFER, indices);
    gl.bindVertexArray(null);
    return { array, buffers };
  }

  release({ array, buffers }) {
    this.gl.deleteVertexArray(array);
    for (const buffer of buffers) this.gl.deleteBuffer(buffer);
  }

  quad(corners) {
    return this.arraysOf("picture", { position: [corners.flat(), 3], place: [CORNERS.flat(), 2] });
  }

  /* Each mesh: `points` and `colours` (vertex, 3), `faces`. */
  setMeshes(meshes) {
    for (const mesh of this.meshes) this.release(mesh.parts);
    this.meshes = meshes.map(({ points, colours, faces: indices }) => ({
      count: indices.length,
      parts: this.arraysOf(
        "mesh",
        { position: [points, 3], normal: [normalsOf(points, indices), 3], rgb: [colours, 3] },
        indices,
      ),
    }));
  }

  setPictures(bitmaps) {
    const gl = this.gl;
    bitmaps.forEach((bitmap, camera) => {
      const held = this.pictures[camera];
      if (held.bitmap === bitmap) return;
      held.bitmap = bitmap;
      if (!bitmap) return;
      gl.bindTexture(gl.TEXTURE_2D, held.texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
      gl.generateMipmap(gl.TEXTURE_2D);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    });
  }

  use(name, clip) {
    const { program, places } = this.programs[name];
    this.gl.useProgram(program);
    this.gl.uniformMatrix4fv(places.clip, true, new Float32Array(clip));
    return places;
  }

  begin(width, height, ratio, background) {
    const gl = this.gl, w = Math.round(width * ratio), h = Math.round(height * ratio);
    if (this.canvas.width !== w || this.canvas.height !== h) [this.canvas.width, this.canvas.height] = [w, h];
    gl.viewport(0, 0, w, h);
    gl.clearColor(...background, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  drawLines(view, name, rgb) {
    const gl = this.gl, places = this.use("line", view.clip), { parts, count } = this.lines[name];
    gl.uniform3fv(places.rgb, rgb);
    gl.bindVertexArray(parts.array);
    gl.drawArrays(gl.LINES, 0, count);
  }

  /* Draw a camera's picture on a quad, if it has one. */
  drawPicture(clip, camera, quad) {
    const gl = this.gl;
    if (!this.pictures[camera].bitmap) return;
    this.use("picture", clip);
    gl.bindTexture(gl.TEXTURE_2D, this.pictures[camera].texture);
    gl.bindVertexArray(quad.array);
    gl.drawArrays(gl.TRIANGLE_FAN, 0, 4);
  }

  drawInRoom(view) {
    this.quads.forEach((quad, camera) => this.drawPicture(view.clip, camera, quad));
  }

  /* Draw a camera's picture behind everything; its corners are places in the window. */
  drawBehind(view, camera, corners) {
    const identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
    const places = corners.map(([x, y]) => [(2 * x) / view.width - 1, 1 - (2 * y) / view.height, 0]);
    const quad = this.quad(places);
    this.gl.disable(this.gl.DEPTH_TEST);
    this.drawPicture(identity, camera, quad);
    this.gl.enable(this.gl.DEPTH_TEST);
    this.release(quad);
  }

  /* Half transparent meshes show their nearest side alone: depth is drawn first, then colour. */
  drawMeshes(view, opacity) {
    const gl = this.gl, places = this.use("mesh", view.clip);
    gl.uniform3fv(places.eye, view.eye);
    gl.uniform1f(places.opacity, opacity);
    for (const inDepth of opacity < 1 ? [true, false] : [false]) {
      gl.colorMask(!inDepth, !inDepth, !inDepth, !inDepth);
      if (!inDepth && opacity < 1) gl.enable(gl.BLEND);
      for (const { parts, count } of this.meshes) {
        gl.bindVertexArray(parts.array);
        gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_SHORT, 0);
      }
    }
    gl.disable(gl.BLEND);
  }
}

function compiled(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const places = {};
  for (const name of ["clip", "eye", "opacity", "rgb"]) places[name] = gl.getUniformLocation(program, name);
  return { program, places };
}

function normalsOf(points, indices) {
  const normals = new Float32Array(points.length);
  const corner = (i) => [points[3 * i], points[3 * i + 1], points[3 * i + 2]];
  for (let f = 0; f < indices.length; f += 3) {
    const [a, b, c] = [corner(indices[f]), corner(indices[f + 1]), corner(indices[f + 2])];
    const normal = cross(plus(b, a, -1), plus(c, a, -1));
    for (let k = 0; k < 3; k++) for (let i = 0; i < 3; i++) normals[3 * indices[f + k] + i] += normal[i];
  }
  return normals;
}
