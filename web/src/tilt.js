// The phone as a window: turning it moves the eye a little, never beyond what was filled.
const FULL_TURN = 22; // degrees that move the eye as far as it may go
const WAKE = 5; // degrees after which the phone leads: no hand is ever quite still
const RECENTER_S = 6; // seconds after which a new way of holding the phone is its middle
const SMOOTHING_S = 0.12; // seconds by which the eye lags behind, so that it does not tremble
const JUMP = 25; // degrees between two events: the sensor's angles have flipped, nobody turned

/** Follow the phone's gyroscope, where there is one. */
export function tilt(viewer) {
  const { DeviceOrientationEvent: sensor } = window;
  if (!sensor || matchMedia("(prefers-reduced-motion: reduce)").matches) return;
  follow(viewer);
  // Some browsers keep silent until they were asked, and may be asked in a tap alone.
  const ask = () => sensor.requestPermission().catch(() => {});
  if (sensor.requestPermission) viewer.canvas.addEventListener("click", ask, { once: true });
}

function follow(viewer) {
  let middle = null; // how the phone is held: [left or right, up or down] in degrees
  let last = null;
  let start = [0, 0]; // where the eye was when the phone began to lead, in disparities
  let leads = false;

  viewer.canvas.addEventListener("pointerdown", () => (middle = null)); // the hand on the picture comes first
  addEventListener("deviceorientation", (event) => {
    const turned = turn(event);
    if (!turned || !viewer.description || viewer.inVr || viewer.canvas.classList.contains("held")) return;
    const now = event.timeStamp / 1000;
    const seconds = last ? Math.min(Math.max(now - last.at, 0), 0.25) : 0;
    const jumped = last && Math.hypot(turned[0] - last.turned[0], turned[1] - last.turned[1]) > JUMP;
    last = { at: now, turned };
    if (!middle || jumped) {
      middle = turned;
      leads = false;
      return;
    }

    const away = turned.map((angle, axis) => angle - middle[axis]);
    if (!leads && Math.hypot(...away) < WAKE) return;
    if (!leads) start = viewer.place2d();
    leads = true;
    const forgotten = 1 - Math.exp(-seconds / RECENTER_S);
    middle = middle.map((angle, axis) => angle + forgotten * away[axis]);
    start = start.map((value) => value * (1 - forgotten));

    // Turned to the right, the screen shows what one sees from farther left.
    const reach = viewer.description.orbit.free / FULL_TURN;
    const goal = start.map((value, axis) => value - reach * away[axis]);
    const share = 1 - Math.exp(-seconds / SMOOTHING_S);
    const eye = viewer.place2d();
    viewer.lookFrom(eye.map((value, axis) => value + share * (goal[axis] - value)));
  });
}

/** How far the phone is turned to the right and up, in degrees, whichever way its picture stands; null without a sensor. */
function turn({ beta, gamma }) {
  if (beta === null || gamma === null) return null;
  const angle = screen.orientation?.angle ?? 0;
  return { 0: [gamma, beta], 90: [beta, -gamma], 180: [-gamma, -beta], 270: [-beta, gamma] }[angle] ?? [gamma, beta];
}
