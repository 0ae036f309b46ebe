import { defineConfig } from "vite";

export default defineConfig({
  // relative addresses: a study may serve the page below a path of its proxy
  base: "./",
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
