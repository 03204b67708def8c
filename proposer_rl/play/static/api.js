// What the server is asked. Addresses are relative: the token stays in the page's own.

/** An answer of api/NAME; without a question it is only read. Throws with the server's line. */
export async function ask(name, question) {
  const options = question && {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(question),
  };
  let answer;
  try {
    answer = await fetch(`api/${name}`, options);
  } catch {
    throw new Error("bin/play does not answer: it has ended, or is far away.");
  }
  if (!answer.ok) {
    const told = await answer.json().catch(() => ({}));
    throw new Error(told.error ?? `The server refused: ${answer.status}.`);
  }
  return answer.json();
}

/** Calls work() again and again as long as it was asked for meanwhile, never twice at once. */
export function latest(work) {
  let busy = false;
  let again = false;
  return async () => {
    again = true;
    if (busy) return;
    busy = true;
    try {
      while (again) {
        again = false;
        await work();
      }
    } finally {
      busy = false;
    }
  };
}
