// The scene as a camera sees it, with its lens.

import * as three from "./three.js";
import { project, ray } from "./lens.js";

/** Places of the image at which the lens is computed: columns and rows; between them it is taken as flat. */
const [COLUMNS, ROWS] = [40, 30];
const NEAR = 0.05;

/**
 * A camera to look through. The scene is drawn without the lens, wide enough for the whole image, and this picture is
 * bent as the lens does.
 */
export class Through {
  constructor(lens) {
    this.lens = lens;
    this.eye = new three.PerspectiveCamera();
    this.eye.position.fromArray(lens.centre);
    // Axes x right, y down, z ahead become x right, y up, z back.
    const r = lens.rotation;
    this.eye.quaternion.setFromRotationMatrix(new three.Matrix4().set(
      r[0], -r[3], -r[6], 0, r[1], -r[4], -r[7], 0, r[2], -r[5], -r[8], 0, 0, 0, 0, 1,
    ));
    this.target = new three.WebGLRenderTarget(1, 1, { samples: 4, type: three.HalfFloatType });
    this.sheet = new three.Mesh(new three.BufferGeometry(), new three.MeshBasicMaterial({
      map: this.target.texture, side: three.DoubleSide, blending: three.NoBlending, toneMapped: false,
    }));
    this.flat = new three.Scene();
    this.flat.add(this.sheet);
    this.paper = new three.OrthographicCamera(0, 1, 0, 1, -1, 1);
    this.ground = new three.Color();
    this.bend();
  }

  /** The sheet: places in the image, and where they are in the picture without the lens. */
  bend() {
    const { lens } = this;
    const nodes = [];
    for (let row = 0; row <= ROWS; row++) {
      for (let column = 0; column <= COLUMNS; column++) {
        const [u, v] = [(column / COLUMNS) * lens.width, (row / ROWS) * lens.height];
        nodes.push({ u, v, at: ray(lens, u, v) });
      }
    }
    const seen = nodes.flatMap(({ at }) => (at ? [at] : []));
    const edge = (axis, most) => seen.reduce((edge, at) => most(edge, at[axis]), 0);
    const [left, right] = [edge(0, Math.min), edge(0, Math.max)];
    const [top, bottom] = [edge(1, Math.min), edge(1, Math.max)];
    this.span = [right - left, bottom - top];
    this.eye.projectionMatrix.makePerspective(left * NEAR, right * NEAR, -top * NEAR, -bottom * NEAR, NEAR, 200);
    this.eye.projectionMatrixInverse.copy(this.eye.projectionMatrix).invert();
    const [places, picture, faces] = [[], [], []];
    for (const { u, v, at = [left, top] } of nodes) {
      places.push(u, v, 0);
      picture.push((at[0] - left) / this.span[0], 1 - (at[1] - top) / this.span[1]);
    }
    for (let row = 0; row < ROWS; row++) {
      for (let column = 0; column < COLUMNS; column++) {
        const first = row * (COLUMNS + 1) + column;
        const four = [first, first + 1, first + COLUMNS + 1, first + COLUMNS + 2];
        if (four.every((node) => nodes[node].at)) faces.push(four[0], four[2], four[1], four[1], four[2], four[3]);
      }
    }
    const { geometry } = this.sheet;
    geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(places), 3));
    geometry.setAttribute("uv", new three.BufferAttribute(new Float32Array(picture), 2));
    geometry.setIndex(faces);
  }

  /** The image fills a canvas of this size in one direction; draws the scene there. */
  draw(renderer, scene, width, height) {
    const { lens, paper, target } = this;
    this.scale = Math.min(width / lens.width, height / lens.height);
    this.corner = [(width - this.scale * lens.width) / 2, (height - this.scale * lens.height) / 2];
    const [left, top] = this.corner.map((pixels) => -pixels / this.scale);
    [paper.left, paper.right] = [left, left + width / this.scale];
    [paper.top, paper.bottom] = [top, top + height / this.scale];
    paper.updateProjectionMatrix();
    const focal = lens.focal_px.map((pixels) => pixels * this.scale * renderer.getPixelRatio());
    const size = this.span.map((span, axis) => Math.min(4096, Math.max(1, Math.round(span * focal[axis]))));
    if (target.width !== size[0] || target.height !== size[1]) target.setSize(...size);
    // What is half transparent would become lighter on a transparent ground.
    renderer.setClearColor(this.ground.set(getComputedStyle(document.body).backgroundColor), 1);
    renderer.setRenderTarget(target);
    renderer.render(scene, this.eye);
    renderer.setClearColor(this.ground, 0);
    const { calls, triangles } = renderer.info.render;
    renderer.setRenderTarget(null);
    renderer.render(this.flat, paper);
    // What the scene costs, not the sheet.
    Object.assign(renderer.info.render, { calls: calls + 1, triangles });
  }

  /** Where a point in the world is on the canvas; undefined behind the camera. */
  place([x, y, z]) {
    return project(this.lens, x, y, z)?.map((pixels, axis) => this.corner[axis] + pixels * this.scale);
  }

  dispose() {
    for (const one of [this.target, this.sheet.geometry, this.sheet.material]) one.dispose();
  }
}
