// The performers and the cameras in 3D.

import * as three from "./three.js";
import { Skins } from "./body.js";
import { lensOf } from "./lens.js";

const MOST = 32;
const JOINTS = 22;
const BONES = JOINTS - 1;
const UP = new three.Vector3(0, 1, 0);

const GREY = new three.Color("#8a8f98");
/** Half of the width of a letter of a name, and the height of a line, pixels. */
const [HALF_LETTER, LINE] = [3.3, 13];

/** The colour of a performer; greyish if the pose is not to be trusted. */
function tinted(out, { tint, state }) {
  out.set(tint);
  return state === "tracking" ? out : out.lerp(GREY, 0.75);
}

/** Bones and joints of all performers, each in its colour: two draw calls. */
class Figures {
  constructor(scene, opacity) {
    const material = new three.MeshLambertMaterial({ transparent: opacity < 1, opacity });
    const bone = new three.CylinderGeometry(1, 0.8, 1, 10);
    const joint = new three.SphereGeometry(1, 12, 8);
    this.bones = new three.InstancedMesh(bone, material, MOST * BONES);
    this.joints = new three.InstancedMesh(joint, material, MOST * (JOINTS + 1));
    for (const mesh of [this.bones, this.joints]) {
      mesh.frustumCulled = false;
      mesh.count = 0;
      scene.add(mesh);
    }
    this.tint = new three.Color();
    this.matrix = new three.Matrix4();
    this.turn = new three.Quaternion();
    this.size = new three.Vector3();
    this.at = new three.Vector3();
    this.from = new three.Vector3();
    this.to = new three.Vector3();
  }

  /** Shows these performers: `{ joints, state, tint, parents, head }`; joints in the world, metres. */
  show(people) {
    let [bones, joints] = [0, 0];
    for (const one of people.slice(0, MOST)) {
      const { joints: points, parents, head } = one;
      tinted(this.tint, one);
      for (let j = 0; j < JOINTS; j++) {
        this.to.fromArray(points, 3 * j);
        const parent = parents[j];
        const size = j === head ? 0.1 : 0.035;
        this.put(this.joints, joints++, this.to, size);
        if (parent < 0) continue;
        this.from.fromArray(points, 3 * parent);
        this.link(bones++);
      }
    }
    [this.bones.count, this.joints.count] = [bones, joints];
    for (const mesh of [this.bones, this.joints]) {
      mesh.instanceMatrix.needsUpdate = true;
      if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
    }
  }

  put(mesh, index, at, size) {
    this.turn.identity();
    this.matrix.compose(at, this.turn, this.size.setScalar(size));
    mesh.setMatrixAt(index, this.matrix);
    mesh.setColorAt(index, this.tint);
  }

  /** A bone between `from` and `to`. */
  link(index) {
    const along = this.at.subVectors(this.to, this.from);
    const length = Math.max(along.length(), 1e-4);
    this.turn.setFromUnitVectors(UP, along.divideScalar(length));
    const radius = Math.min(0.055, Math.max(0.018, 0.14 * length));
    this.size.set(radius, length, radius);
    this.at.addVectors(this.from, this.to).multiplyScalar(0.5);
    this.matrix.compose(this.at, this.turn, this.size);
    this.bones.setMatrixAt(index, this.matrix);
    this.bones.setColorAt(index, this.tint);
  }
}

export class View {
  constructor(canvas, labels) {
    this.canvas = canvas;
    this.labels = labels;
    /** Why there is no picture. */
    this.error = "";
    try {
      this.renderer = new three.WebGLRenderer({ canvas, antialias: true, alpha: true });
      this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    } catch {
      this.error = "This browser shows no 3D: WebGL is switched off or missing.";
    }
    this.scene = new three.Scene();
    this.camera = new three.PerspectiveCamera(45, 1, 0.05, 200);
    this.camera.position.set(3.5, 2.4, 4.5);
    this.controls = new three.OrbitControls(this.camera, canvas);
    this.controls.target.set(0, 0.9, 0);
    const sun = new three.DirectionalLight("#ffffff", 1.8);
    sun.position.set(3, 6, 4);
    this.scene.add(new three.HemisphereLight("#ffffff", "#667078", 1.6), sun);
    const floor = new three.GridHelper(20, 20, "#7d8791", "#8a949e");
    [floor.material.transparent, floor.material.opacity] = [true, 0.55];
    this.scene.add(floor);
    this.final = new Figures(this.scene, 1);
    this.ghosts = new Figures(this.scene, 0.35);
    [this.skins, this.showSkins, this.tint] = [undefined, true, new three.Color()];
    this.frusta = undefined;
    this.tags = new Map();
    this.followed = undefined;
    /** The camera to look through; undefined: free. */
    this.through = undefined;
    [this.point, this.drawn] = [new three.Vector3(), new three.Vector2()];
  }

  /** What all bodies share, see body.js; without it performers are bones. */
  setTemplate(template) {
    this.skins = new Skins(this.scene, template);
  }

  /** The cameras of a rig, as pyramids with names. */
  setRig(rig) {
    if (this.frusta) {
      this.scene.remove(this.frusta);
      this.frusta.geometry.dispose();
      this.frusta.material.dispose();
    }
    const corners = [];
    this.lenses = rig.cameras.map(lensOf);
    for (const lens of this.lenses) {
      const depth = 0.35;
      const corner = (u, v) => this.inWorld(lens, [
        ((u - lens.centre_px[0]) / lens.focal_px[0]) * depth, ((v - lens.centre_px[1]) / lens.focal_px[1]) * depth, depth,
      ]);
      const [width, height] = [lens.width, lens.height];
      const four = [corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
      four.forEach((one, k) => corners.push(lens.centre, one, one, four[(k + 1) % 4]));
      const top = this.inWorld(lens, [0, (-lens.centre_px[1] / lens.focal_px[1]) * depth * 1.25, depth]);
      corners.push(four[0], top, top, four[1]);
    }
    const geometry = new three.BufferGeometry();
    geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(corners.flat()), 3));
    this.frusta = new three.LineSegments(geometry, new three.LineBasicMaterial({ color: "#77828e" }));
    this.scene.add(this.frusta);
  }

  inWorld(lens, [x, y, z]) {
    const r = lens.rotation;
    return [0, 1, 2].map((k) => lens.centre[k] + r[k] * x + r[3 + k] * y + r[6 + k] * z);
  }

  /** The scene as a camera sees it, or free again. */
  lookThrough(through) {
    this.through?.dispose();
    this.through = through;
    this.controls.enabled = through === undefined;
  }

  /** Everything in view. */
  frameAll(people) {
    const points = [...(this.lenses ?? []).map(({ centre }) => centre), ...people.map(({ joints }) => [...joints.slice(0, 3)])];
    if (points.length === 0) return;
    const [low, high] = [Math.min, Math.max].map((most) => [0, 1, 2].map((k) => most(...points.map((p) => p[k]))));
    const middle = low.map((x, k) => (x + high[k]) / 2);
    const narrow = Math.max(1, (1.2 * this.canvas.clientHeight) / Math.max(this.canvas.clientWidth, 1));
    this.controls.target.set(middle[0], Math.min(middle[1], 1), middle[2]);
    this.camera.aspect = this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1);
    this.camera.updateProjectionMatrix();
    const isSeen = (at) => {
      const { x, y, z } = this.point.fromArray(at).project(this.camera);
      return Math.abs(x) < 0.95 && Math.abs(y) < 0.95 && z < 1;
    };
    for (let reach = narrow * 1.5; ; reach *= 1.1) {
      this.camera.position.set(middle[0] + 0.9 * reach, reach, middle[2] + 1.35 * reach);
      this.camera.lookAt(this.controls.target);
      this.camera.updateMatrixWorld();
      if (points.every(isSeen) || reach > 100) return;
    }
  }

  /** The place on the floor, x and z in metres, that is seen at a place of the window; undefined above the horizon. */
  floorAt(x, y) {
    const box = this.canvas.getBoundingClientRect();
    if (this.through) return this.through.floorAt(x - box.left, y - box.top);
    this.point.set((2 * (x - box.left)) / box.width - 1, 1 - (2 * (y - box.top)) / box.height, 0.5).unproject(this.camera);
    const from = this.camera.position;
    const share = from.y / (from.y - this.point.y);
    return share > 0 ? [from.x + share * (this.point.x - from.x), from.z + share * (this.point.z - from.z)] : undefined;
  }

  /** The performer at a place of the canvas, or undefined. */
  pick(x, y, people) {
    const box = this.canvas.getBoundingClientRect();
    let [best, nearest] = [undefined, 40];
    for (const one of people) {
      for (let j = 0; j < JOINTS; j++) {
        const at = this.place(one.joints.subarray(3 * j, 3 * j + 3), box.width, box.height);
        const distance = at ? Math.hypot(at[0] - (x - box.left), at[1] - (y - box.top)) : Infinity;
        if (distance < nearest) [best, nearest] = [one.name, distance];
      }
    }
    return best;
  }

  /** Where a point in the world is on the canvas; undefined behind the camera. */
  place(at, width, height) {
    if (this.through) return this.through.place(at);
    const { x, y, z } = this.point.fromArray(at).project(this.camera);
    return z > 1 ? undefined : [((x + 1) / 2) * width, ((1 - y) / 2) * height];
  }

  draw(people, ghosts) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!this.renderer) return;
    const size = this.renderer.getSize(this.drawn);
    if (size.x !== width || size.y !== height) this.renderer.setSize(width, height, false);
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.updateProjectionMatrix();
    const hasSkin = (one) => this.skins !== undefined && this.showSkins && one.skin !== undefined;
    this.final.show(people.filter((one) => !hasSkin(one)));
    this.skins?.show(people.filter(hasSkin).slice(0, MOST), (one) => tinted(this.tint, one));
    this.ghosts.show(ghosts);
    const followed = people.find(({ name }) => name === this.followed);
    if (followed && this.through === undefined) {
      this.point.fromArray(followed.joints, 0).sub(this.controls.target);
      this.controls.target.add(this.point);
      this.camera.position.add(this.point);
    }
    if (this.frusta) this.frusta.visible = this.through === undefined;
    if (this.controls.enabled) this.controls.update();
    if (this.through) this.through.draw(this.renderer, this.scene, width, height);
    else this.renderer.render(this.scene, this.camera);
    this.label(people, width, height);
  }

  label(people, width, height) {
    const wanted = new Map();
    if (this.through === undefined) {
      for (const lens of this.lenses ?? []) wanted.set(`camera ${lens.name}`, [lens.name, lens.centre]);
    }
    for (const { name, shown, joints, head, state } of people) {
      const at = [joints[3 * head], joints[3 * head + 1] + 0.25, joints[3 * head + 2]];
      wanted.set(`performer ${name}`, [state === "tracking" ? shown : `${shown} (${state})`, at]);
    }
    for (const [key, tag] of this.tags) {
      if (wanted.has(key)) continue;
      tag.remove();
      this.tags.delete(key);
    }
    // The names of performers do not overlap: one that would is higher.
    const taken = [];
    for (const [key, [text, at]] of wanted) {
      let tag = this.tags.get(key);
      if (!tag) {
        tag = this.labels.appendChild(document.createElement("span"));
        this.tags.set(key, tag);
      }
      if (tag.textContent !== text) [tag.textContent, tag.half] = [text, HALF_LETTER * text.length];
      const place = this.place(at, width, height);
      tag.hidden = place === undefined;
      let [x, y] = place ?? [0, 0];
      if (place && key.startsWith("performer")) {
        const isOver = ([u, v, half]) => Math.abs(u - x) < half + tag.half && Math.abs(v - y) < LINE;
        while (taken.some(isOver)) y -= LINE;
        taken.push([x, y, tag.half]);
      }
      tag.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px) translate(-50%, -50%)`;
    }
  }

  get figures() {
    const { render } = this.renderer?.info ?? { render: { calls: 0, triangles: 0 } };
    const skins = [...(this.skins?.all.values() ?? [])].filter(({ mesh }) => mesh.visible).length;
    return { calls: render.calls, triangles: render.triangles, skins, ghosts: this.ghosts.joints.count / JOINTS };
  }
}
