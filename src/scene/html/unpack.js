// Unpacks the parts of the page and starts the player.
(async () => {
  const say = (text) => {
    document.getElementById("message").textContent = text;
  };
  const taken = (id) => {
    const part = document.getElementById(id);
    const bytes = Uint8Array.from(atob(part.textContent), (c) => c.charCodeAt(0));
    part.remove();
    return bytes;
  };
  const inflated = async (id) => {
    const stream = new Blob([taken(id)]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  };
  if (!("DecompressionStream" in window) || !document.createElement("canvas").getContext("webgl2")) {
    say("This browser is too old, or WebGL 2 is switched off: the scene cannot be drawn.");
    return;
  }
  try {
    const player = new TextDecoder().decode(await inflated("player"));
    globalThis.splat4d = { scene: taken("scene"), sorter: await inflated("sorter") };
    const script = document.createElement("script");
    script.textContent = player;
    document.body.append(script);
  } catch (error) {
    say(`The page is damaged: ${error.message}`);
  }
})();
