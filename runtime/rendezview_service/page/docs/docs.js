// The API, to read and to try: Swagger UI on the service's own description.

const token = sessionStorage.getItem("rendezview-token"); // as the main page keeps it
const answer = await fetch("../openapi.json", token ? { headers: { Authorization: `Bearer ${token}` } } : {});

if (!answer.ok) {
  document.getElementById("api").textContent =
    answer.status === 401 ? "The service requires a token: enter it on its main page, in this tab, then come back." : `The description cannot be read (${answer.status}).`;
} else {
  const ui = window.SwaggerUIBundle({
    spec: await answer.json(),
    dom_id: "#api",
    deepLinking: true,
    validatorUrl: null, // loads nothing from other servers
    onComplete: () => token && ui.preauthorizeApiKey("HTTPBearer", token),
  });
}
