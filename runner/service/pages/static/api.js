// Requests to the API; an error has the message of the response.
export async function request(address) {
  const response = await fetch(address);
  const body = await response.json().catch(() => null);
  if (!response.ok) throw new Error(body?.error.message ?? `The service responded with status ${response.status}.`);
  return body;
}
