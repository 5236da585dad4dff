// The skin of the performers. src/core/body/mesh explains bones and weights.

import * as three from "./three.js";

/** The numbers in a text of base64, as `Type`. */
export function numbers(text, Type) {
  const bytes = Uint8Array.from(atob(text), (one) => one.charCodeAt(0));
  return new Type(bytes.buffer);
}

/** Vertices from tenths of millimetres, metres. */
export const metres = (tenths) => Float32Array.from(tenths, (one) => one / 1e4);

/** What all bodies share. */
export class Template {
  constructor({ faces, bones, weights, turns, bulge, parents }) {
    Object.assign(this, { turns, bulge, parents });
    this.faces = new three.BufferAttribute(numbers(faces, Uint16Array), 1);
    this.bones = new three.BufferAttribute(numbers(bones, Uint8Array), 4);
    this.weights = new three.BufferAttribute(numbers(weights, Uint8Array), 4, true);
    const some = (Type) => parents.map(() => new Type());
    [this.world, this.rest, this.joints] = [some(three.Quaternion), some(three.Vector3), some(three.Vector3)];
    [this.local, this.turn] = [new three.Quaternion(), new three.Quaternion()];
    [this.size, this.matrix] = [new three.Vector3(), new three.Matrix4()];
  }

  /** The world rotations of all joints; `rotations`: a quaternion for each, the root's in the world. */
  turnJoints(rotations) {
    this.parents.forEach((parent, j) => {
      this.world[j].fromArray(rotations, 4 * j);
      if (parent >= 0) this.world[j].premultiply(this.world[parent]);
    });
  }

  /** The joints of a pose, as x y z x y z ..., in metres. */
  forward(offsets, root, rotations) {
    this.turnJoints(rotations);
    const out = new Float32Array(3 * this.parents.length);
    this.parents.forEach((parent, j) => {
      const at = this.joints[j].fromArray(parent < 0 ? root : offsets, parent < 0 ? 0 : 3 * j);
      if (parent >= 0) at.applyQuaternion(this.world[parent]).add(this.joints[parent]);
      at.toArray(out, 3 * j);
    });
    return out;
  }

  /** Writes the matrices from the rest pose to a pose, 16 numbers for each bone. */
  pose(offsets, joints, rotations, out) {
    this.turnJoints(rotations);
    this.parents.forEach((parent, j) => {
      this.rest[j].fromArray(offsets, 3 * j);
      if (parent < 0) this.rest[j].setScalar(0);
      else this.rest[j].add(this.rest[parent]);
      this.joints[j].fromArray(joints, 3 * j);
    });
    this.turns.forEach(([j, part], bone) => {
      if (part === 1) return this.put(bone, j, this.world[j], this.size.setScalar(1), out);
      this.turn.slerpQuaternions(this.world[this.parents[j]], this.world[j], part);
      this.put(bone, j, this.turn, this.bulged(j, rotations), out);
    });
  }

  /** The scale of the bones between a joint and its parent, by axis. */
  bulged(j, rotations) {
    const { bent, raised, axes } = this.bulge[j];
    const { x, y, z, w } = this.local.fromArray(rotations, 4 * j);
    const more = bent * 2 * (x * x + y * y + z * z) + raised * 2 * w * z;
    return this.size.fromArray(axes).multiplyScalar(more).addScalar(1);
  }

  /** A bone that turns about joint `j`. */
  put(bone, j, turn, scale, out) {
    this.matrix.makeRotationFromQuaternion(turn).scale(scale);
    this.matrix.setPosition(this.size.copy(this.rest[j]).applyMatrix4(this.matrix).negate().add(this.joints[j]));
    this.matrix.toArray(out, 16 * bone);
  }
}

/** Bones whose matrices `Template.pose` writes; three.js must not compute them. */
class Bones extends three.Skeleton {
  constructor(count) {
    super(Array.from({ length: count }, () => new three.Bone()));
  }

  update() {}
}

/** Skins that are kept, shown or not: who is hidden comes back at once. */
const KEPT = 40;

/** The skins of all performers: a draw call each. */
export class Skins {
  constructor(scene, template) {
    [this.scene, this.template, this.all] = [scene, template, new Map()];
  }

  /** Shows performers that have `{ name, joints, rotations, skin: { rest, offsets } }`, in the colour that `tint` gives. */
  show(people, tint) {
    for (const { mesh } of this.all.values()) mesh.visible = false;
    for (const one of people) {
      const { name, joints, rotations, skin } = one;
      const { mesh, of } = this.all.get(name) ?? {};
      const shown = of === skin ? mesh : this.make(name, skin);
      shown.visible = true;
      shown.material.color.copy(tint(one));
      this.template.pose(skin.offsets, joints, rotations, shown.skeleton.boneMatrices);
      if (shown.skeleton.boneTexture) shown.skeleton.boneTexture.needsUpdate = true;
    }
    for (const [name, { mesh }] of this.all) if (!mesh.visible && this.all.size > KEPT) this.drop(name);
  }

  make(name, skin) {
    this.drop(name);
    const geometry = new three.BufferGeometry();
    geometry.setAttribute("position", new three.BufferAttribute(skin.rest, 3));
    geometry.setAttribute("skinIndex", this.template.bones);
    geometry.setAttribute("skinWeight", this.template.weights);
    geometry.setIndex(this.template.faces);
    geometry.computeVertexNormals();
    const mesh = new three.SkinnedMesh(geometry, new three.MeshLambertMaterial());
    mesh.frustumCulled = false;
    mesh.bind(new Bones(this.template.turns.length), new three.Matrix4());
    this.scene.add(mesh);
    this.all.set(name, { mesh, of: skin });
    return mesh;
  }

  drop(name) {
    const { mesh } = this.all.get(name) ?? {};
    if (!mesh) return;
    this.scene.remove(mesh);
    for (const one of [mesh.geometry, mesh.material, mesh.skeleton]) one.dispose();
    this.all.delete(name);
  }
}
