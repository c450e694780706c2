// SPDX-License-Identifier: Apache-2.0
// The page of the REST API: its paths, each of which can be tried.
const element = (tag, text, parent) => {
  const made = document.createElement(tag);
  made.textContent = text;
  parent.append(made);
  return made;
};
const tryOut = (path, parent) => {
  const form = element("form", "", parent);
  const input = element("input", "", form);
  input.value = path.replace("{path}", "vehicles/1/components/1/messages/ATTITUDE")
    + (path.includes("helper") ? "?name=COMMAND_LONG" : "");
  input.setAttribute("aria-label", "path");
  element("button", "Get", form);
  const out = element("pre", "", parent);
  out.hidden = true;
  form.onsubmit = async (event) => {
    event.preventDefault();
    const answer = await fetch(input.value);
    out.textContent = `${answer.status}\n${await answer.text()}`;
    out.hidden = false;
  };
};
fetch("/docs.json").then((answer) => answer.json()).then((api) => {
  for (const [path, methods] of Object.entries(api.paths)) {
    for (const [method, what] of Object.entries(methods)) {
      const section = element("section", "", document.querySelector("main"));
      element("h2", `${method.toUpperCase()} ${path}`, section);
      element("p", what.description ?? what.summary ?? "", section);
      if (method === "get") tryOut(path, section);
    }
  }
});
