import { readFileSync } from "node:fs";
import { defineConfig } from "vite";

const english = JSON.parse(readFileSync(new URL("../texts/en.json", import.meta.url), "utf-8"));

export default defineConfig({
  // relative addresses: a study may serve the page below a path of its proxy
  base: "./",
  define: { ENGLISH: JSON.stringify(english.live) },
  build: {
    target: "es2022",
    // no inlined data and no module preload script: the Content-Security-Policy allows neither
    assetsInlineLimit: 0,
    modulePreload: false,
    sourcemap: false,
    chunkSizeWarningLimit: 800,
    rolldownOptions: {
      output: {
        entryFileNames: "assets/[name]-[hash].js",
        chunkFileNames: "assets/[name]-[hash].js",
        assetFileNames: "assets/[name]-[hash][extname]",
      },
    },
  },
});
