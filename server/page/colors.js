// Colour maps made in OKLab, where equal steps look equal: lightness is a straight line in each of
// them, so that the order of values also shows in grey and to those who see colours differently.

const STEPS = 256;

// OKLab to sRGB, 0..1 each, cut to what a screen has. Matrices: B. Ottosson, "A perceptual color
// space for image processing", 2020.
function srgb(L, a, b) {
  const l = (L + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (L - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (L - 0.0894841775 * a - 1.291485548 * b) ** 3;
  const linear = [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ];
  return linear.map((c) => {
    const x = Math.min(1, Math.max(0, c));
    return x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055;
  });
}

function polar(L, chroma, degrees) {
  const angle = (degrees * Math.PI) / 180;
  return srgb(L, chroma * Math.cos(angle), chroma * Math.sin(angle));
}

const mix = (a, b, t) => a + (b - a) * t;

const MAPS = {
  // Violet, blue, green, yellow: lightness 0.30 to 0.93, hue from 300 down to 105 degrees. As strong as a screen has them:
  // at t = 0.4, between blue and green, chroma 0.098 is the most, and what is cut off shows as edges that are not there.
  sequential: (t) => polar(mix(0.3, 0.93, t), 0.097 + 0.16 * (t - 0.4) ** 2, mix(300, 105, t ** 0.9)),
  // Blue, neutral, red; the middle is pale, or dark where the page is.
  diverging: (t, dark) => {
    const u = 2 * t - 1;
    const size = Math.abs(u);
    const L = dark ? mix(0.42, 0.8, size) : mix(0.9, 0.42, size);
    return polar(L, 0.005 + (dark ? 0.115 : 0.155) * size ** 0.85, u < 0 ? mix(235, 262, dark ? 1 - size : size) : mix(55, 27, dark ? 1 - size : size));
  },
  grey: (t) => srgb(mix(0.25, 0.92, t), 0, 0),
};

// 256 RGBA bytes of a map.
export function table(name, dark) {
  const bytes = new Uint8Array(4 * STEPS);
  for (let k = 0; k < STEPS; k++) {
    const rgb = MAPS[name](k / (STEPS - 1), dark);
    for (let c = 0; c < 3; c++) bytes[4 * k + c] = Math.round(255 * rgb[c]);
    bytes[4 * k + 3] = 255;
  }
  return bytes;
}

// Round values between low and high, about n of them.
export function ticks(low, high, n = 5) {
  const span = high - low;
  if (!(span > 0)) return [low];
  const raw = span / n;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((f) => f * power).find((s) => s >= raw * 0.999);
  const out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * span; k++) out.push(k * step + 0);
  return out;
}
