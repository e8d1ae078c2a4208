// A page that grows: asks for its version, and loads itself again when there is a newer one; what is unfolded stays so.
(() => {
  const folds = () => [...document.querySelectorAll("details")];
  const status = document.getElementById("live-status");
  for (const number of JSON.parse(sessionStorage.getItem("unfolded") || "[]")) if (folds()[number]) folds()[number].open = true;
  const look = async () => {
    let version;
    try {
      version = await (await fetch("version", { cache: "no-store" })).text();
    } catch {
      status.textContent = "The run, or what shows it, has ended; this is the last that was seen of it.";
      return;
    }
    if (version !== document.body.dataset.version && !document.querySelector("dialog[open]")) {
      sessionStorage.setItem("unfolded", JSON.stringify(folds().flatMap((fold, number) => (fold.open ? [number] : []))));
      location.reload();
    }
    setTimeout(look, 1000);
  };
  setTimeout(look, 1000);
})();
