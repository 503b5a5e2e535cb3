// Bundles the page's scripts into src/spackle/web/page: viewer.js and the licences. index.html and viewer.css lie there.
import { createHash } from "node:crypto";
import { readFileSync, readdirSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";

const OUT = "../src/spackle/web/page";
const SOURCES = ["build.mjs", "package-lock.json", "package.json", ...readdirSync("src").map((name) => `src/${name}`)];

// A test works out the same digest, to notice a bundle that is older than its sources.
function digest() {
  const hash = createHash("sha256");
  for (const name of SOURCES.sort()) {
    hash.update(`${name}\0`).update(readFileSync(name)).update("\0");
  }
  return hash.digest("hex");
}

// Spark's WebAssembly is most of the bundle; compressed it is a third.
const compressWasm = {
  name: "compress-wasm",
  setup({ onLoad }) {
    onLoad({ filter: /spark\.module\.js$/ }, ({ path }) => {
      const text = readFileSync(path, "utf8");
      const found = /const WASM = decode64\("([A-Za-z0-9+/=]+)"\)\.buffer;\nconst WASM_MODULE = WebAssembly\.compile\(WASM\);/.exec(text);
      if (!found) throw new Error("Spark keeps its WebAssembly elsewhere: look again");
      const packed = gzipSync(Buffer.from(found[1], "base64"), { level: 9 }).toString("base64");
      const wasm = `import { gunzip } from ${JSON.stringify(join(process.cwd(), "src/bytes.js"))};
const WASM_MODULE = gunzip("${packed}").then((bytes) => WebAssembly.compile(bytes));`;
      return { contents: text.replace(found[0], () => wasm), loader: "js" };
    });
  },
};

function licences() {
  const packages = ["three", "@sparkjsdev/spark", "fflate"].map((name) => {
    const { version } = JSON.parse(readFileSync(`node_modules/${name}/package.json`));
    return `${name} ${version}\n\n${readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim()}`;
  });
  const ours = "viewer.js holds the page of Spackle (Apache-2.0, see LICENSE of the project) and these packages:";
  return [ours, ...packages].join(`\n\n${"-".repeat(80)}\n\n`) + "\n";
}

await build({
  entryPoints: ["src/main.js"],
  outfile: `${OUT}/viewer.js`,
  bundle: true,
  minify: true,
  format: "iife",
  target: ["es2022", "chrome111", "firefox114", "safari16.4"],
  charset: "ascii",
  legalComments: "none",
  banner: { js: `/* built from web/ by "make viewer", sources ${digest()}\n\n${licences()}*/` },
  plugins: [compressWasm],
});
writeFileSync(`${OUT}/licenses.txt`, licences());
