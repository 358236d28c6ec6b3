// Builds the player of exported pages (see README.md): one script and Spark's module that sorts, each
// through gzip, and the licences of all that is in them.
//
//   node build.js [FOLDER]    FOLDER: where to, ../../src/scene/html by default

import { build } from "esbuild";
import { mkdir, readFile, writeFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";

const here = dirname(fileURLToPath(import.meta.url));
const target = process.argv[2] ?? join(here, "../../src/scene/html");
// What ends up in the page; fflate comes with Spark.
const packages = ["three", "@sparkjsdev/spark", "fflate", "fzstd"];

// Spark holds its WebAssembly module as base64 in its source. Taken out, it is a fifth smaller when
// compressed; the page puts it where the source looks for it.
let sorter;
const takeOut = {
  name: "take the module out",
  setup({ onLoad }) {
    onLoad({ filter: /spark\.module\.js$/ }, async ({ path }) => {
      const source = await readFile(path, "utf8");
      const parts = source.split(/\bdecode64\("(AGFzbQ[A-Za-z0-9+/=]+)"\)/);
      if (parts.length !== 3) throw new Error(`${path}: not one WebAssembly module but ${(parts.length - 1) / 2}`);
      sorter = Buffer.from(parts[1], "base64");
      return { contents: `${parts[0]}globalThis.splat4d.sorter${parts[2]}`, loader: "js" };
    });
  },
};

const { outputFiles } = await build({
  entryPoints: [join(here, "src/main.js")],
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  charset: "utf8",
  legalComments: "none",
  // The viewer's modules, which the player shares, lie outside of this folder.
  nodePaths: [join(here, "node_modules")],
  plugins: [takeOut],
  write: false,
});

const licences = [];
for (const name of packages) {
  const folder = join(here, "node_modules", name);
  const { version, license } = JSON.parse(await readFile(join(folder, "package.json"), "utf8"));
  const text = await readFile(join(folder, "LICENSE"), "utf8");
  licences.push(`${name} ${version} (${license})\n\n${text.trim().replaceAll("\r\n", "\n")}\n`);
}

await mkdir(target, { recursive: true });
const write = (name, bytes) => writeFile(join(target, name), bytes);
await write("player.js.gz", gzipSync(outputFiles[0].contents, { level: 9 }));
await write("sorter.wasm.gz", gzipSync(sorter, { level: 9 }));
await write("licences.txt", licences.join(`\n${"-".repeat(72)}\n\n`));
