// What the API answers; its words are those of the error if it refuses.
export async function asked(address) {
  const answer = await fetch(address);
  const found = await answer.json().catch(() => null);
  if (!answer.ok) throw new Error(found?.error.message ?? `The service answers ${answer.status}.`);
  return found;
}
