// A headset that nobody wears, in place of the browser's own WebXR: what it "shows" can be read back.
// A test sets `headset.there`, `headset.pose` and `headset.layers`, draws by `headset.frame()`, and reads `headset.picture()`.
// It refuses what a real one refuses: a session without a click, a picture of a context that is not made for it.
(() => {
  const EYES = { left: -1, right: 1 };
  const headset = {
    there: true, // whether the browser has one
    layers: false, // whether it takes layers (XRWebGLBinding), as standalone headsets do, or one picture (XRWebGLLayer)
    refuses: null, // the name of the error with which it refuses sessions, or "picture": it begins, and takes none
    size: [96, 72], // pixels of an eye
    focal: 80, // pixels
    apart: 0.064, // metres between the eyes
    pose: { position: [0, 0, 0], yaw: 0 }, // of the head: metres, y up; radians to the left
    session: null,
    drawnTo: null, // the texture of what it shows
  };
  let compatible = false;
  WebGL2RenderingContext.prototype.makeXRCompatible = async () => void (compatible = true);

  class Space extends EventTarget {}

  class Session extends EventTarget {
    constructor() {
      super();
      Object.assign(this, { renderState: {}, inputSources: [], enabledFeatures: ["viewer", "local"], visibilityState: "visible", waiting: new Map(), count: 0 });
    }
    async requestReferenceSpace(type) {
      if (!this.enabledFeatures.includes(type)) throw new DOMException(type, "NotSupportedError");
      return new Space();
    }
    updateRenderState(state) {
      Object.assign(this.renderState, state);
    }
    requestAnimationFrame(callback) {
      this.waiting.set(++this.count, callback);
      return this.count;
    }
    cancelAnimationFrame(id) {
      this.waiting.delete(id);
    }
    async end() {
      headset.session = null;
      this.waiting.clear();
      this.dispatchEvent(new Event("end"));
    }
  }

  /** A transform as WebXR has it: the head's, moved `right` metres along its own axis. */
  function transform(right) {
    const { position, yaw } = headset.pose;
    const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
    const [x, y, z] = [position[0] + right * cos, position[1], position[2] - right * sin];
    return {
      position: { x, y, z, w: 1 },
      orientation: { x: 0, y: Math.sin(yaw / 2), z: 0, w: Math.cos(yaw / 2) },
      matrix: new Float32Array([cos, 0, -sin, 0, 0, 1, 0, 0, sin, 0, cos, 0, x, y, z, 1]),
    };
  }

  function views({ depthNear = 0.1, depthFar = 1000 }) {
    const [width, height] = headset.size;
    const third = [(depthFar + depthNear) / (depthNear - depthFar), (2 * depthFar * depthNear) / (depthNear - depthFar)];
    const lens = [(2 * headset.focal) / width, 0, 0, 0, 0, (2 * headset.focal) / height, 0, 0, 0, 0, third[0], -1, 0, 0, third[1], 0];
    return Object.entries(EYES).map(([eye, side]) => ({
      eye, projectionMatrix: new Float32Array(lens), transform: transform((side * headset.apart) / 2),
    }));
  }

  function viewport({ eye }) {
    const [width, height] = headset.size;
    return { x: eye === "left" ? 0 : width, y: 0, width, height };
  }

  function texture(gl, format) {
    const bound = gl.getParameter(gl.TEXTURE_BINDING_2D);
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, 2 * headset.size[0], headset.size[1]);
    gl.bindTexture(gl.TEXTURE_2D, bound);
    return made;
  }

  function framebuffer(gl, color) {
    const bound = gl.getParameter(gl.FRAMEBUFFER_BINDING);
    const made = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, made);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, color, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, bound);
    return made;
  }

  function begin(session, gl) {
    if (session !== headset.session || !compatible || headset.refuses) throw new DOMException("not for this session", "InvalidStateError");
    headset.gl = gl;
    headset.drawnTo = texture(gl, gl.RGBA8);
    return headset.drawnTo;
  }

  window.XRWebGLLayer = class {
    constructor(session, gl) {
      this.framebuffer = framebuffer(gl, begin(session, gl));
      [this.framebufferWidth, this.framebufferHeight] = [2 * headset.size[0], headset.size[1]];
      this.ignoreDepthValues = false;
    }
    getViewport(view) {
      return viewport(view);
    }
  };

  class Binding {
    constructor(session, gl) {
      Object.assign(this, { session, gl });
    }
    getViewSubImage(layer, view) {
      return { colorTexture: layer.color, depthStencilTexture: layer.depth, viewport: viewport(view) };
    }
  }
  class BindingWithLayers extends Binding {
    createProjectionLayer({ depthFormat }) {
      const color = begin(this.session, this.gl);
      const depth = depthFormat ? texture(this.gl, depthFormat) : null;
      return { color, depth, textureWidth: 2 * headset.size[0], textureHeight: headset.size[1], ignoreDepthValues: false };
    }
  }
  Object.defineProperty(window, "XRWebGLBinding", { get: () => (headset.layers ? BindingWithLayers : Binding) });

  class System extends EventTarget {
    async isSessionSupported(mode) {
      return headset.there && mode === "immersive-vr";
    }
    async requestSession(mode, { requiredFeatures = [] } = {}) {
      if (headset.refuses && headset.refuses !== "picture") throw new DOMException("no", headset.refuses);
      if (!navigator.userActivation.isActive) throw new DOMException("no click", "SecurityError");
      if (headset.session) throw new DOMException("busy", "InvalidStateError");
      if (requiredFeatures.some((name) => name !== "local")) throw new DOMException("unknown", "NotSupportedError");
      return (headset.session = new Session());
    }
  }
  Object.defineProperty(navigator, "xr", { value: new System() });

  /** One picture of the session, in which a page may draw. */
  headset.frame = () => {
    const { session } = headset;
    const calls = [...session.waiting.values()];
    session.waiting.clear();
    const frame = {
      session,
      getViewerPose: () => ({ transform: transform(0), views: views(session.renderState) }),
    };
    for (const call of calls) call(performance.now(), frame);
    return calls.length;
  };

  /** What the eyes see, left beside right: {width, height, rgba}, the top row first, bytes as letters in base64. */
  headset.picture = () => {
    const { gl, drawnTo } = headset;
    const [width, height] = [2 * headset.size[0], headset.size[1]];
    const pixels = new Uint8Array(4 * width * height);
    const bound = gl.getParameter(gl.FRAMEBUFFER_BINDING);
    const from = framebuffer(gl, drawnTo);
    gl.bindFramebuffer(gl.FRAMEBUFFER, from);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    gl.bindFramebuffer(gl.FRAMEBUFFER, bound);
    gl.deleteFramebuffer(from);
    const rows = Array.from({ length: height }, (_, row) => pixels.subarray(4 * width * (height - 1 - row), 4 * width * (height - row)));
    return { width, height, rgba: btoa(rows.map((row) => String.fromCharCode(...row)).join("")) };
  };

  /** Draw until the scene is in order for where the head is; what the eyes see then. */
  headset.see = async () => {
    headset.frame();
    await spackle.settled();
    headset.frame();
    return headset.picture();
  };

  window.headset = headset;
})();
