// Runs before the page's modules, in browsers of any age, and names missing features instead of leaving a blank page.
(() => {
  var started = false;

  function say(text) {
    var panel = document.getElementById("failure");
    panel.textContent = text;
    panel.hidden = false;
    document.getElementById("state").hidden = true;
    started = true;
  }

  function check() {
    var script = document.createElement("script"),
      canvas = document.createElement("canvas"),
      context;
    if (!("noModule" in script) || typeof Promise.prototype.finally !== "function")
      return "This browser is too old for the vineyard: open this address in Chrome, Edge, Firefox or Safari of 2022 or later.";
    if (window.WebGL2RenderingContext) context = canvas.getContext("webgl2");
    if (!context)
      return "This browser has no WebGL 2: switch on hardware acceleration in its settings, or open this address in another browser.";
    var drop = context.getExtension("WEBGL_lose_context");
    if (drop) drop.loseContext();
    return "";
  }

  /** Called by main.js when the vineyard is loaded; after that main.js reports failures itself. */
  window.pageStarted = () => {
    started = true;
  };
  window.addEventListener(
    "error",
    (event) => {
      if (started) return;
      say(
        event.message
          ? "This browser cannot run the page (" +
              event.message +
              "): use Chrome, Edge, Firefox or Safari of 2022 or later."
          : "A part of the page did not load: is the client still running? Then load the page again.",
      );
    },
    true,
  );
  window.pageMisses = check();
  if (window.pageMisses) say(window.pageMisses);
})();
