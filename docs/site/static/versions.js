// Lists the versions of the site under its name, if it is one of several (docs/site/versions.py).
const root = new URL(document.documentElement.dataset.content_root, location.href);
const here = decodeURIComponent(root.pathname.split("/").at(-2));

async function addVersions() {
  const reply = await fetch(new URL("../versions.json", root));
  const names = reply.ok ? await reply.json() : [];
  if (!names.includes(here)) return;
  const list = document.createElement("select");
  list.className = "versions";
  list.setAttribute("aria-label", "Version");
  for (const name of names) list.add(new Option(name, name, false, name === here));
  list.onchange = async () => {
    const other = new URL(`../${encodeURIComponent(list.value)}/`, root);
    const page = new URL(location.href.slice(root.href.length), other);
    const found = await fetch(page, { method: "HEAD" }); // an older version may lack the page
    location.href = found.ok ? page : other;
  };
  document.querySelector(".sidebar-brand").after(list);
}

if (location.protocol !== "file:" && /^(\d|main$)/.test(here)) addVersions();
