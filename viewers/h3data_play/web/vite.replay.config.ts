import { defineConfig } from "vite";

// the script and the styles that `h3data_viewers.html_replay` puts into one file with a recording
export default defineConfig({
  publicDir: false,
  build: {
    target: "es2022",
    outDir: "../../h3data_viewers/html_replay/page",
    emptyOutDir: false,
    assetsInlineLimit: 0,
    modulePreload: false,
    sourcemap: false,
    chunkSizeWarningLimit: 800,
    rolldownOptions: {
      input: "src/replay/main.ts",
      output: { entryFileNames: "replay.js", assetFileNames: "replay[extname]" },
    },
  },
});
