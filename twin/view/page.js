// Reports held driving keys to the server, and hands dropped photos to the page's upload button.
(() => {
  const KEYS = ["w", "a", "s", "d"];
  const held = new Set();
  let socket = null;
  let driving = false;

  const report = () => {
    if (socket !== null && socket.readyState === WebSocket.OPEN) socket.send([...held].join(""));
  };
  const release = () => {
    if (held.size === 0) return;
    held.clear();
    report();
  };
  const connect = () => {
    socket = new WebSocket(location.origin.replace(/^http/, "ws") + "/keys");
    socket.onmessage = (event) => {
      driving = JSON.parse(event.data).driving;
      document.documentElement.dataset.driving = driving;
      if (!driving) release();
    };
    socket.onclose = () => setTimeout(connect, 2000);
  };
  connect();

  const typing = (target) =>
    target.isContentEditable ||
    target.tagName === "TEXTAREA" ||
    (target.tagName === "INPUT" && ["text", "number", "search", ""].includes(target.type));

  // In the capture phase, before viser's own handlers, which would move the camera.
  window.addEventListener(
    "keydown",
    (event) => {
      const key = event.key.toLowerCase();
      if (!driving || !KEYS.includes(key) || event.ctrlKey || event.metaKey || event.altKey || typing(event.target))
        return;
      event.stopImmediatePropagation();
      event.preventDefault();
      if (held.has(key)) return;
      held.add(key);
      report();
    },
    true,
  );
  window.addEventListener(
    "keyup",
    (event) => {
      if (held.delete(event.key.toLowerCase())) report();
    },
    true,
  );
  window.addEventListener("blur", release);
  document.addEventListener("visibilitychange", release);
  setInterval(() => {
    if (held.size > 0) report();
  }, 100);

  const isPhoto = (event) => event.dataTransfer !== null && [...event.dataTransfer.types].includes("Files");
  window.addEventListener("dragover", (event) => {
    if (isPhoto(event)) event.preventDefault();
  });
  window.addEventListener("drop", (event) => {
    if (!isPhoto(event)) return;
    event.preventDefault();
    const input = document.querySelector('input[type="file"][accept^="image/"]');
    if (input === null || event.dataTransfer.files.length === 0) return;
    input.files = event.dataTransfer.files;
    input.dispatchEvent(new Event("change", { bubbles: true }));
  });
})();
