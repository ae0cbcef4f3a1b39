// The attributes of a LAS or LAZ file as the LAZRsLoader of loaders.gl reads them, as JSON.
const fs = require("fs");
const path = require("path");
const { pathToFileURL } = require("url");

const online = globalThis.fetch; // Node's cannot read the loader's WebAssembly from a file
globalThis.fetch = async (url, ...more) =>
  String(url).startsWith("file:")
    ? new Response(fs.readFileSync(new URL(url)), { headers: { "content-type": "application/wasm" } })
    : online(url, ...more);

async function read(file) {
  const load = (name) => import(pathToFileURL(path.join(process.env.NODE_PATH, "@loaders.gl", name, "dist", "index.js")));
  const core = await load("core");
  const las = await load("las");
  const bytes = fs.readFileSync(file);
  const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
  const data = await core.load(buffer, las.LAZRsLoader, { worker: false, las: { shape: "mesh", fp64: true } });
  return Object.fromEntries(Object.entries(data.attributes).map(([name, one]) => [name, Array.from(one.value)]));
}

read(process.argv[2]).then((found) => fs.writeFileSync(process.argv[3], JSON.stringify(found)));
