// Draws a scene: Spark on three.js, blended in linear RGB like Spackle's own renderer, then brought to the canvas.
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { decode } from "./splats.js";
import { disparityOf, lookingAxes } from "./views.js";

const LAYERS = { both: 0, base: 1, aux: 2 }; // what the shader leaves out: nothing, aux, base
const LONGEST = 4096;

// Base and aux are one set in one order, so a layer is switched on and off without sorting again.
const LOOKUP = "ivec3 texCoord = splatTexCoord(int(splatIndex));";
const SWITCH = `bool isAux = int(splatIndex) < spackleAux;
    if ((spackleLeftOut == 1 && isAux) || (spackleLeftOut == 2 && !isAux)) return;
    ${LOOKUP}`;
// Colours become linear once a Gaussian, by sRGB's own curve; Spark does it for each pixel, by a gamma of 2.2.
const COLOR = "rgba.rgb = max(rgba.rgb, vec3(0.0));";
const LINEAR = "rgba.rgb = mix(rgba.rgb / 12.92, pow((rgba.rgb + 0.055) / 1.055, vec3(2.4)), step(0.04045, rgba.rgb));";
const GAMMA = "rgba.rgb = srgbToLinear(rgba.rgb);";

const FRAGMENT = `
uniform sampler2D picture;
uniform sampler2D base;
uniform float split; // share of the width that shows the base
uniform bool heat;
in vec2 at;
out vec4 color;
vec3 encoded(vec3 c) {
  c = clamp(c, 0.0, 1.0);
  return mix(c * 12.92, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
}
void main() {
  vec3 seen = encoded(at.x < split ? texture(base, at).rgb : texture(picture, at).rgb);
  if (heat) {
    float hole = clamp(1.0 - texture(base, at).a, 0.0, 1.0);
    vec3 glow = mix(vec3(1.0, 0.78, 0.22), vec3(0.93, 0.16, 0.36), smoothstep(0.1, 1.0, hole));
    seen = mix(seen, glow, 0.72 * smoothstep(0.02, 0.5, hole));
  }
  color = vec4(seen, 1.0);
}`;
const VERTEX = "out vec2 at; void main() { at = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }";

export class Stage {
  /** @param {HTMLCanvasElement} canvas @param {() => void} onDirty called when something better can be drawn */
  constructor(canvas, onDirty) {
    // Nothing here needs a depth buffer but three.js, which makes no picture for a headset without one.
    const depth = Boolean(navigator.xr);
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, alpha: false, depth, stencil: false });
    this.renderer.autoClear = false;
    this.camera = new THREE.PerspectiveCamera();
    this.camera.matrixAutoUpdate = false;
    this.scene = new THREE.Scene();
    this.switches = { spackleAux: { value: 0 }, spackleLeftOut: { value: 0 } };
    this.spark = this.makeSpark(onDirty);
    this.scene.add(this.spark);
    this.targets = [this.makeTarget(), this.makeTarget()];
    this.flat = new THREE.Scene();
    this.sheet = this.makeSheet();
    this.flat.add(this.sheet);
    this.eye = [0, 0, 0];
    this.zoom = { scale: 1, x: 0, y: 0 };
    this.layers = "both";
    this.heat = false;
    this.split = null;
    this.spare = null; // where is drawn while the canvas keeps its picture
  }

  makeSpark(onDirty) {
    const spark = new SparkRenderer({
      renderer: this.renderer,
      onDirty,
      extraUniforms: this.switches,
      accumExtSplats: true, // float32 centres: half floats are a quarter of a pixel off
      enableLod: false,
      depthTest: false,
      sortRadial: false,
      maxStdDev: 3.33, // exp(-½ 3.33²) is 1/255, where our renderer stops
      minAlpha: 1 / 255,
      maxPixelRadius: 4096,
      blurAmount: 0,
      clipXY: 2,
    });
    const { material } = spark;
    const patched = replaced(replaced(material.vertexShader, LOOKUP, SWITCH), COLOR, COLOR + LINEAR);
    material.vertexShader = `uniform int spackleAux;\nuniform int spackleLeftOut;\n${patched}`;
    material.fragmentShader = replaced(material.fragmentShader, GAMMA, "");
    return spark;
  }

  makeTarget() {
    const gl = this.renderer.getContext();
    const half = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    // Without half floats an 8-bit sRGB target still blends in linear RGB.
    const kind = half ? { type: THREE.HalfFloatType } : { colorSpace: THREE.SRGBColorSpace };
    return new THREE.WebGLRenderTarget(1, 1, { ...kind, depthBuffer: false });
  }

  makeSheet() {
    const uniforms = { picture: { value: null }, base: { value: null }, split: { value: 0 }, heat: { value: false } };
    const material = new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms, depthTest: false, toneMapped: false,
    });
    const sheet = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), material);
    sheet.frustumCulled = false;
    return sheet;
  }

  /** Take a scene in place of the one before, whose picture stays until this one is settled. */
  async replace(description, layers) {
    this.spare = new THREE.WebGLRenderTarget(1, 1, { depthBuffer: false });
    this.show(description, layers);
    await this.settled();
    this.spare.dispose();
    this.spare = null;
    this.draw();
  }

  /** Take a scene in place of the one before; `layers` are the description's, with their `bytes`. */
  show(description, layers) {
    const splats = decode(layers);
    if (this.mesh) {
      this.scene.remove(this.mesh);
      this.mesh.dispose();
    }
    this.description = description;
    this.mesh = new SplatMesh({ extSplats: splats, editable: false, raycastable: false });
    this.switches.spackleAux.value = layers.find(({ name }) => name === "aux").count;
    this.scene.add(this.mesh);
  }

  resize(width, height) {
    if (this.renderer.xr.isPresenting) return; // the canvas has the headset's size
    this.renderer.setSize(width, height, false);
  }

  /** The photo's lens on a canvas of its shape, zoomed and shifted. */
  lens() {
    const { K, width: W, height: H } = this.description.camera;
    const { scale, x, y } = this.zoom;
    const [cx, cy] = [(2 * K[0][2]) / W - 1, (2 * K[1][2]) / H - 1];
    const [px, py] = [scale * cx + x, -scale * cy + y];
    // Depth is always 0: there is no depth buffer, and so neither a near hand nor a far sky is cut off.
    this.camera.projectionMatrix.set(
      (2 * K[0][0] * scale) / W, 0, -px, 0,
      0, (2 * K[1][1] * scale) / H, -py, 0,
      0, 0, 0, 0,
      0, 0, -1, 0,
    );
  }

  /** Keep the zoomed picture from leaving its frame. */
  clampZoom() {
    const { scale, x, y } = this.zoom;
    Object.assign(this.zoom, { x: clamp(x, scale - 1), y: clamp(y, scale - 1) });
  }

  pose() {
    const [right, down, forward] = lookingAxes(this.eye, this.description.focus);
    const [x, y, z] = this.eye;
    // Columns: right, up, back, as three.js has it.
    this.camera.matrix.set(
      right[0], -down[0], -forward[0], x,
      right[1], -down[1], -forward[1], y,
      right[2], -down[2], -forward[2], z,
      0, 0, 0, 1,
    );
    this.camera.updateMatrixWorld(true);
  }

  draw() {
    if (!this.mesh) return;
    const size = this.renderer.getDrawingBufferSize(new THREE.Vector2());
    this.drawTo(this.spare, size.x, size.y);
  }

  drawTo(target, width, height) {
    const { xr } = this.renderer;
    this.lens();
    this.pose();
    const enabled = xr.enabled;
    xr.enabled = false; // the page's eye, also while a headset shows the scene
    this.compose(target, width, height, this.split);
    xr.enabled = enabled;
  }

  /** Draw what the eyes of a headset see into its picture, in which they stand side by side. */
  drawEyes() {
    const target = this.renderer.getRenderTarget();
    this.compose(target, target.width, target.height, null); // a divider would part the eyes
  }

  /** Draw the layers that are shown, blended in linear RGB, and bring them to a target; left of `split` the base alone. */
  compose(target, width, height, split) {
    const [whole, bare] = this.targets;
    const share = split ?? 0;
    const column = Math.round(share * width);
    // Only what is looked at is drawn: left of the divider the base, right of it everything.
    if (share < 1) this.drawLayers(whole, split === null ? this.layers : "both", width, height, column, width);
    if (share > 0 || this.heat) this.drawLayers(bare, "base", width, height, 0, this.heat ? width : column);
    const { uniforms } = this.sheet.material;
    uniforms.picture.value = whole.texture;
    uniforms.base.value = bare.texture;
    uniforms.split.value = column / width;
    uniforms.heat.value = this.heat;
    const { xr } = this.renderer;
    const enabled = xr.enabled;
    xr.enabled = false; // one sheet over all eyes
    this.renderer.setRenderTarget(target);
    this.renderer.render(this.flat, this.camera);
    this.renderer.setRenderTarget(null);
    xr.enabled = enabled;
  }

  drawLayers(target, layers, width, height, from, to) {
    if (target.width !== width || target.height !== height) target.setSize(width, height);
    target.scissorTest = true;
    target.scissor.set(from, 0, to - from, height);
    this.switches.spackleLeftOut.value = LAYERS[layers];
    this.renderer.setRenderTarget(target);
    this.renderer.setClearColor(0x000000, 0);
    this.renderer.clear();
    this.renderer.render(this.scene, this.camera);
  }

  /** Whether the Gaussians are being brought into another order, or will be soon. */
  get sorting() {
    const { sorting, sortDirty, updateTimeoutId } = this.spark;
    return sorting || sortDirty || updateTimeoutId !== -1; // in VR Spark waits for the frame's end
  }

  /** Resolves when the Gaussians are in order for this eye and drawn so. */
  settled() {
    this.again = true;
    this.settling ??= this.settle().finally(() => (this.settling = null));
    return this.settling;
  }

  async settle() {
    await this.mesh.initialized;
    while (this.again) {
      this.again = false;
      const { isPresenting } = this.renderer.xr;
      if (!isPresenting) this.draw();
      while (this.sorting) {
        this.again = !isPresenting; // a head is never still
        await pause(4);
      }
    }
  }

  /** What is seen, as a 2D canvas of width × height. */
  async picture(width, height) {
    const shrink = Math.min(1, LONGEST / Math.max(width, height));
    const [w, h] = [width, height].map((side) => Math.max(1, Math.round(side * shrink)));
    await this.settled();
    const target = new THREE.WebGLRenderTarget(w, h, { depthBuffer: false });
    this.drawTo(target, w, h);
    const pixels = new Uint8ClampedArray(4 * w * h);
    await this.renderer.readRenderTargetPixelsAsync(target, 0, 0, w, h, pixels);
    target.dispose();
    this.draw();
    const canvas = Object.assign(document.createElement("canvas"), { width: w, height: h });
    const image = new ImageData(w, h);
    for (let row = 0; row < h; row++) {
      image.data.set(pixels.subarray(4 * w * (h - 1 - row), 4 * w * (h - row)), 4 * w * row);
    }
    canvas.getContext("2d").putImageData(image, 0, 0);
    return canvas;
  }

  get disparity() {
    return disparityOf(this.description, this.eye);
  }
}

function replaced(shader, old, now) {
  if (!shader.includes(old)) throw new Error(`Spark's shader has changed: it has no "${old}"`);
  return shader.replace(old, now);
}

function clamp(value, most) {
  return Math.min(Math.max(value, -most), most);
}

function pause(milliseconds) {
  return new Promise((resolve) => setTimeout(resolve, milliseconds));
}
