// The search's index has as many bytes as two pages. It is read when someone goes to search, not with every page.
(() => {
  const { open, send } = XMLHttpRequest.prototype, late = new WeakSet();
  let wanted = /[?&]q=/.test(location.search), waiting = [];
  XMLHttpRequest.prototype.open = function (method, address, ...rest) {
    if (String(address).endsWith("/search/search_index.json")) late.add(this);
    return open.call(this, method, address, ...rest);
  };
  XMLHttpRequest.prototype.send = function (body) {
    if (wanted || !late.has(this)) return send.call(this, body);
    waiting.push(() => send.call(this, body));
  };
  document.addEventListener("focusin", (event) => {
    if (!event.target.closest("[data-md-component=search]")) return;
    wanted = true;
    waiting.splice(0).forEach((read) => read());
  });
})();
