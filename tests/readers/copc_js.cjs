// All columns of a LAS or LAZ file as copc.js and laz-perf read them, as JSON. Scales are left out: copc.js 0.0.8 reads
// them with the wrong byte order.
const fs = require("fs");
const { Las } = require("copc");
const { createLazPerf } = require("laz-perf");

async function read(path) {
  const bytes = new Uint8Array(fs.readFileSync(path));
  const get = async (begin, end) => bytes.slice(begin, end);
  const header = Las.Header.parse(bytes.slice(0, 375));
  const vlrs = await Las.Vlr.walk(get, header);
  const record = Las.Vlr.find(vlrs, "LASF_Spec", 4);
  const wkt = Las.Vlr.find(vlrs, "LASF_Projection", 2112);
  const extra = record ? Las.ExtraBytes.parse(await Las.Vlr.fetch(get, record)) : [];
  const stored = extra.map(({ scale, offset, ...one }) => one);
  const end = header.pointDataOffset + header.pointCount * header.pointDataRecordLength;
  const points = path.endsWith(".laz")
    ? await Las.PointData.decompressFile(bytes, await createLazPerf())
    : bytes.slice(header.pointDataOffset, end);
  const view = Las.View.create(points, header, stored);
  const columns = {};
  for (const name of Object.keys(view.dimensions)) {
    const value = view.getter(name);
    columns[name] = Array.from({ length: view.pointCount }, (_, row) => value(row));
  }
  const text = wkt ? new TextDecoder().decode(await Las.Vlr.fetch(get, wkt)) : null;
  return { header, extra: stored, columns, wkt: text };
}

read(process.argv[2]).then((found) => fs.writeFileSync(process.argv[3], JSON.stringify(found)));
