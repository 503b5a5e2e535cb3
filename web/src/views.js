// Where the eye stands and how it looks: the conventions of src/spackle/core/trajectories.py and src/spackle/core/camera.py.

/** Eye [x, y, z] in metres on a path, at t in 0..1; the path's samples come from Python. */
export function eyeOnPath(description, kind, disparity, t) {
  const { still, moving } = description.paths[kind];
  const at = Math.min(Math.max(t, 0), 1) * (still.length - 1);
  const before = Math.min(Math.floor(at), still.length - 2);
  const share = at - before;
  return [0, 1, 2].map((axis) => {
    const [a, b] = [before, before + 1].map((k) => still[k][axis] + disparity * moving[k][axis]);
    return a + share * (b - a);
  });
}

/** world_to_camera (OpenCV) of an eye that looks at the focus point, y down, as 3 rows of [right, down, forward]. */
export function lookingAxes(eye, focus) {
  const forward = unit([-eye[0], -eye[1], focus - eye[2]]);
  const right = unit([forward[2], 0, -forward[0]]); // down × forward, down being y
  return [right, cross(forward, right), forward];
}

/** How far from the photo's eye, in disparities. */
export function disparityOf(description, eye) {
  return Math.hypot(eye[0], eye[1]) / description.orbit.unit;
}

/** The eye for where the hand has pulled it, [x, y] in disparities: it follows up to `free` and never passes `limit`. */
export function held(description, pulled) {
  const { free, limit } = description.orbit;
  const far = Math.hypot(...pulled);
  if (far <= free) return pulled;
  const room = limit - free;
  const gone = free + room * (1 - Math.exp((free - far) / room));
  return pulled.map((value) => (value * gone) / far);
}

/** Where the hand must have pulled for the eye to stand there: the inverse of `held`. */
export function pulledTo(description, at) {
  const { free, limit } = description.orbit;
  const far = Math.hypot(...at);
  if (far <= free) return at;
  const room = limit - free;
  const pulled = free - room * Math.log(Math.max(0.05, 1 - (far - free) / room));
  return at.map((value) => (value * pulled) / far);
}

const NEAREST_M = 1; // metres to the nearest thing in VR, where nobody knows the scene's size
const LEAST_RANGE_M = 0.1; // metres to each side: half the distance of two eyes, and as much again to move them

/** How many metres in VR a length of 1 on the page is: the scene's own size, where it has one and both eyes have room. */
export function metresPerUnit({ orbit, isMetric, lengthFactor = 1, zNear }) {
  const ownSize = isMetric ? 1 / lengthFactor : NEAREST_M / zNear;
  return Math.max(ownSize, LEAST_RANGE_M / (orbit.limit * orbit.unit));
}

/**
 * Where a head may be that has moved [right, down, forward] from the photo's eye, so that eyes `apart` from it look
 * from where the scene was filled: to the sides as far as a hand may pull, forward as far as a path goes, never back.
 */
export function headHeld({ orbit, paths }, [right, down, forward], apart) {
  const reach = Math.max(0, orbit.limit * orbit.unit - apart);
  const far = Math.hypot(right, down);
  const share = far > reach ? reach / far : 1;
  const { still, moving } = paths["rotate-forward"];
  const most = Math.max(...still.map((place, k) => place[2] + orbit.limit * moving[k][2]));
  return [right * share, down * share, Math.min(Math.max(forward, 0), most)];
}

function unit(vector) {
  const length = Math.hypot(...vector);
  return vector.map((value) => value / length);
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
