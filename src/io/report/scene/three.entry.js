// What the scene uses of three.js. three.js beside this file is made from it:
//   npm install three@0.187.0 esbuild@0.28.2
//   npx esbuild three.entry.js --bundle --minify --format=esm --legal-comments=inline --outfile=bundle.js
//   (echo "/*! three.js 0.187.0"; cat node_modules/three/LICENSE; echo "*/"; cat bundle.js) > three.js
export {
  Bone, BufferAttribute, BufferGeometry, Color, CylinderGeometry, DirectionalLight, DoubleSide, GridHelper,
  HalfFloatType, HemisphereLight, InstancedMesh, LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial,
  MeshLambertMaterial, NoBlending, OrthographicCamera, PerspectiveCamera, Quaternion, Scene, Skeleton, SkinnedMesh,
  SphereGeometry, Vector2, Vector3, WebGLRenderTarget, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
