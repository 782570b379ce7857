use super::conditions::offered;
use super::*;

#[tokio::test]
async fn a_token_for_programs_gives_and_takes_no_access_and_is_named_in_the_audit_trail() {
    let (_folder, cloud) = Cloud::of_test().await;
    let root = User { name: "root".to_owned(), role: Role::Admin };
    token_of(&cloud, "root", Role::Admin).await;
    let new = NewToken { name: "ci".to_owned(), role: Role::Admin, days: 1 };
    let token = cloud.store.make_token((&root, (&root.name).into()), new).await.unwrap().token;
    let mut with_login = String::new();
    for Endpoint { method, path, role, needs_login, .. } in endpoints() {
        // It would end the token.
        if role.is_none() || (&method, path) == (&Method::DELETE, "/v1/login") {
            continue;
        }
        let named = path.replace("{change}", "start").replace("{sha256}", &"0".repeat(64));
        let named = named.replace(['{', '}'], "");
        let status = status_of(&cloud, method.clone(), &named, Some(&token)).await;
        // It removes itself only.
        let is_other = path == "/v1/tokens/{user}/{name}";
        let is_refused = needs_login || is_other;
        assert_eq!(status == StatusCode::FORBIDDEN, is_refused, "{method} {path}: {status}");
        with_login += &if needs_login { format!("{method} {path}, ") } else { String::new() };
    }
    let expected = "POST /v1/tokens, POST /v1/users, DELETE /v1/users/{name}, POST /v1/vehicles, \
                    DELETE /v1/vehicles/{name}, POST /v1/vehicles/{name}/agree, \
                    PUT /v1/clips/policy, ";
    assert_eq!(with_login, expected);
    let ghost = r#"{"name":"ghost"}"#;
    let sent = send(&cloud, (Method::POST, "/v1/vehicles"), Some(&token), &[], ghost).await;
    assert_eq!(sent.json()["title"], "token `ci` is for programs, and this needs a login");
    assert!(cloud.store.vehicles("", 9).await.unwrap().is_empty());
    cloud.store.deploy("root", &offered(1)).await.unwrap();
    let stop = (Method::POST, "/v1/deployments/brake/stop");
    assert_eq!(send(&cloud, stop, Some(&token), &[], "").await.status, StatusCode::OK);
    let path = "/v1/login";
    let status = status_of(&cloud, Method::DELETE, path, Some(&token)).await;
    assert_eq!(status, StatusCode::NO_CONTENT);
    let entries = cloud.store.audit(u64::MAX, 2).await.unwrap();
    let entries: Vec<_> = entries.iter().map(|it| [&*it.actor, &it.action, &it.subject]).collect();
    let actor = "root (token ci)";
    assert_eq!(entries, [[actor, "logout", "root"], [actor, "stop", "brake"]]);
}
