// The scene as a camera sees it, with its lens.

import * as three from "./three.js";
import { project, ray } from "./lens.js";

/** Places of the image at which the lens is computed: columns and rows; between them it is taken as flat. */
const [COLUMNS, ROWS] = [40, 30];
const NEAR = 0.05;
/** Most pixels of the picture without the lens, each way. */
const MOST = 2048;

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
    this.image = new three.Mesh(new three.BufferGeometry(), new three.MeshBasicMaterial({
      map: this.target.texture, side: three.DoubleSide, blending: three.NoBlending, toneMapped: false,
    }));
    this.imageScene = new three.Scene();
    this.imageScene.add(this.image);
    this.imageCamera = new three.OrthographicCamera(0, 1, 0, 1, -1, 1);
    this.background = new three.Color();
    this.bend();
  }

  /** The image: places in it, and where they are in the picture without the lens. */
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
    const { geometry } = this.image;
    geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(places), 3));
    geometry.setAttribute("uv", new three.BufferAttribute(new Float32Array(picture), 2));
    geometry.setIndex(faces);
  }

  /** The image fills a canvas of this size in one direction; draws the scene there. */
  draw(renderer, scene, width, height) {
    const { lens, imageCamera, target } = this;
    this.scale = Math.min(width / lens.width, height / lens.height);
    this.corner = [(width - this.scale * lens.width) / 2, (height - this.scale * lens.height) / 2];
    const [left, top] = this.corner.map((pixels) => -pixels / this.scale);
    [imageCamera.left, imageCamera.right] = [left, left + width / this.scale];
    [imageCamera.top, imageCamera.bottom] = [top, top + height / this.scale];
    imageCamera.updateProjectionMatrix();
    const focal = lens.focal_px.map((pixels) => pixels * this.scale * renderer.getPixelRatio());
    const size = this.span.map((span, axis) => Math.min(MOST, Math.max(1, Math.round(span * focal[axis]))));
    if (target.width !== size[0] || target.height !== size[1]) target.setSize(...size);
    // What is half transparent would become lighter on a transparent background.
    renderer.setClearColor(this.background.set(getComputedStyle(document.body).backgroundColor), 1);
    renderer.setRenderTarget(target);
    renderer.render(scene, this.eye);
    renderer.setClearColor(this.background, 0);
    const { calls, triangles } = renderer.info.render;
    renderer.setRenderTarget(null);
    renderer.render(this.imageScene, imageCamera);
    // What the scene costs, not the image.
    Object.assign(renderer.info.render, { calls: calls + 1, triangles });
  }

  /** Where a point in the world is on the canvas; undefined behind the camera. */
  place([x, y, z]) {
    return project(this.lens, x, y, z)?.map((pixels, axis) => this.corner[axis] + pixels * this.scale);
  }

  /** The place on the floor, x and z, at a place of the canvas; undefined above the horizon. */
  floorAt(x, y) {
    const { lens, corner, scale } = this;
    const [u, v] = [(x - corner[0]) / scale, (y - corner[1]) / scale];
    const isInside = u >= 0 && v >= 0 && u <= lens.width && v <= lens.height;
    const at = isInside ? ray(lens, u, v) : undefined;
    const ahead = at && [0, 1, 2].map((k) => lens.rotation[k] * at[0] + lens.rotation[3 + k] * at[1] + lens.rotation[6 + k]);
    const share = ahead ? -lens.centre[1] / ahead[1] : 0;
    return share > 0 && Number.isFinite(share) ? [0, 2].map((k) => lens.centre[k] + share * ahead[k]) : undefined;
  }

  dispose() {
    for (const one of [this.target, this.image.geometry, this.image.material]) one.dispose();
  }
}
