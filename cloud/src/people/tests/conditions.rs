use std::collections::BTreeMap;

use gleaner_protocol::vehicle_api::GrantStatus;

use super::*;
use crate::store::OfferedDeployment;

pub(super) fn offered(release: u64) -> OfferedDeployment {
    OfferedDeployment {
        id: "brake".to_owned(),
        release,
        envelope: format!("envelope {release}"),
        revision: "r".to_owned(),
        fallback: None,
        grants: GrantStatus::default(),
        selector: BTreeMap::new(),
        revisions: BTreeMap::from([("r".to_owned(), "revision".to_owned())]),
        waves: None,
    }
}

#[tokio::test]
async fn a_change_is_made_only_of_the_state_that_it_expects() {
    let (_folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "ann", Role::Admin).await;
    cloud.store.deploy("console", &offered(1)).await.unwrap();
    let path = "/v1/deployments/brake";
    let read = async |path: &str, headers: &[(&str, &str)]| {
        send(&cloud, (Method::GET, path), Some(&token), headers, "").await
    };
    let stop = async |tag: &str| {
        let path = format!("{path}/stop");
        send(&cloud, (Method::POST, &path), Some(&token), &[("if-match", tag)], "").await
    };
    let tag = |answer: &ApiAnswer| answer.headers[header::ETAG].to_str().unwrap().to_owned();
    let (one, all) = (read(path, &[]).await, read("/v1/deployments", &[]).await);
    assert_eq!(one.json(), all.json()["items"][0]);
    for (path, tag) in [(path, tag(&one)), ("/v1/deployments", tag(&all))] {
        for known in [tag.clone(), format!("\"x\", W/{tag}"), "*".to_owned()] {
            let answer = read(path, &[("if-none-match", &known)]).await;
            assert_eq!(answer.status, StatusCode::NOT_MODIFIED, "{known}");
            assert!(answer.body.is_empty() && answer.headers[header::ETAG] == tag);
        }
        assert_eq!(read(path, &[("if-none-match", "\"x\"")]).await.status, StatusCode::OK);
    }
    // What a vehicle does is no change of what is wanted of it.
    cloud.store.invite_vehicle("console", "car-7").await.unwrap();
    cloud.store.execute("UPDATE vehicles SET epoch = 1").await;
    let moved = read(path, &[]).await;
    assert_ne!(tag(&moved), tag(&one));
    for bad in ["x", "\"", "", "\"a\" \"b"] {
        assert_eq!(stop(bad).await.status, StatusCode::BAD_REQUEST, "{bad}");
    }
    for other in ["\"x\"".to_owned(), tag(&all), format!("W/{}", tag(&one))] {
        assert_eq!(stop(&other).await.status, StatusCode::PRECONDITION_FAILED, "{other}");
    }
    let stopped = stop(&format!("\"x\", {}", tag(&one))).await;
    assert_eq!((stopped.status, &stopped.json()["is_wanted"]), (StatusCode::OK, &json!(false)));
    assert_eq!(tag(&stopped), tag(&read(path, &[]).await));
    // Now it is another one.
    let headers: &[_] = &[("if-match", &*tag(&one))];
    let refused = send(&cloud, (Method::DELETE, path), Some(&token), headers, "").await;
    assert_eq!(refused.status, StatusCode::PRECONDITION_FAILED);
    let headers: &[_] = &[("if-match", &*tag(&stopped))];
    let removed = send(&cloud, (Method::DELETE, path), Some(&token), headers, "").await;
    assert_eq!(removed.status, StatusCode::NO_CONTENT);
    assert_eq!(stop("*").await.status, StatusCode::NOT_FOUND);
}

#[tokio::test]
async fn a_request_with_a_key_has_its_effect_once() {
    let (_folder, cloud) = Cloud::of_test().await;
    let token = token_of(&cloud, "ann", Role::Admin).await;
    let other = token_of(&cloud, "bea", Role::Admin).await;
    let invite = async |token: &str, path: &str, key: &str, body: &'static str| {
        let headers: &[_] = &[("idempotency-key", key)];
        send(&cloud, (Method::POST, path), Some(token), headers, body).await.status
    };
    let entries = async || cloud.store.audit(u64::MAX, 100).await.unwrap().len();
    let (users, eve) = ("/v1/users", r#"{"name":"eve","role":"viewer"}"#);
    for key in ["", "a b", "ä", &"k".repeat(129)] {
        assert_eq!(invite(&token, users, key, eve).await, StatusCode::BAD_REQUEST, "{key}");
    }
    // A request that fails is not remembered.
    assert_eq!(invite(&token, users, "k", r#"{"name":"/","role":"viewer"}"#).await, 400);
    let before = entries().await;
    assert_eq!(invite(&token, users, "k", eve).await, StatusCode::OK);
    // The code is not kept, so that it cannot be sent again.
    assert_eq!(invite(&token, users, "k", eve).await, StatusCode::CONFLICT);
    let changed = r#"{"name":"eve","role":"admin"}"#;
    assert_eq!(invite(&token, users, "k", changed).await, StatusCode::UNPROCESSABLE_ENTITY);
    let vehicle = r#"{"name":"car-7"}"#;
    let vehicles = "/v1/vehicles";
    assert_eq!(invite(&token, vehicles, "k", vehicle).await, StatusCode::UNPROCESSABLE_ENTITY);
    assert_eq!(entries().await, before + 1);
    // Keys are of their users.
    assert_eq!(invite(&other, users, "k", eve).await, StatusCode::OK);
    // Of two at the same time, one is carried out.
    let (first, second) = tokio::join!(
        invite(&token, vehicles, "v", vehicle),
        invite(&token, vehicles, "v", vehicle)
    );
    let mut both = [first.as_u16(), second.as_u16()];
    both.sort_unstable();
    assert_eq!((both, entries().await), ([200, 409], before + 3));
    // Without a secret, the answer is the same.
    let key = crate::store::RequestKey { name: "d".to_owned(), request: "digest".to_owned() };
    let author = ChangeAuthor { name: "ann", user: "ann", key: Some(&key), versions: None };
    let number = cloud.store.deploy(author, &offered(1)).await.unwrap().0;
    cloud.store.set_wanted("bea", "brake", false).await.unwrap();
    assert_eq!(cloud.store.deploy(author, &offered(1)).await.unwrap(), (number, vec![]));
    assert!(!cloud.store.deployment("brake").await.unwrap().is_wanted, "it is not started again");
    // A day later, the key is free.
    cloud.store.execute("UPDATE request_keys SET time = time - 86400").await;
    assert_eq!(invite(&token, users, "k", eve).await, StatusCode::OK);
    let stored = cloud.store.kept_answers().await;
    assert!(stored.iter().all(|answer| answer.parse::<u64>().is_ok() || answer.is_empty()));
}
