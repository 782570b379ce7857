use super::*;

#[tokio::test]
async fn an_address_that_cannot_be_used_is_answered_by_a_page() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut user = Browser::of(&cloud, "ann", Role::Viewer).await;
    for path in ["/clips?after=x", "/vehicles?page=-1", "/vehicles/%ff"] {
        let reply = user.get(path).await;
        assert_eq!(reply.status, StatusCode::BAD_REQUEST, "{path}");
        assert!(reply.has("Something went wrong") && reply.has("use the links"), "{}", reply.text);
        assert!(reply.headers.contains_key(header::CONTENT_SECURITY_POLICY));
    }
    let reply = user.post("/clips", &[]).await;
    assert_eq!(reply.status, StatusCode::METHOD_NOT_ALLOWED);
    assert!(reply.has("Something went wrong"), "{}", reply.text);
}

#[tokio::test]
async fn streams_that_last_keep_no_page_from_being_read() {
    let (_folder, cloud) = Cloud::of_test().await;
    cloud.store.invite_vehicle("console", "car-1").await.unwrap();
    let mut user = Browser::of(&cloud, "ann", Role::Viewer).await;
    let streams: Vec<_> = std::iter::from_fn(|| cloud.readers.open("ann").ok()).collect();
    let path = "/vehicles/car-1/events";
    let stream = user.get(&format!("{path}/stream")).await;
    assert_eq!(stream.status, StatusCode::TOO_MANY_REQUESTS);
    assert_eq!(user.get(path).await.status, StatusCode::OK);
    drop(streams);
}

#[tokio::test]
async fn a_user_in_a_loop_does_not_fill_the_audit_trail() {
    let (_folder, cloud) = Cloud::of_test().await;
    let mut user = Browser::of(&cloud, "ann", Role::Viewer).await;
    let mut made = 0;
    loop {
        let fields = [("name", "loop"), ("role", "viewer"), ("days", "1")];
        let reply = user.post("/account/tokens", &fields).await;
        if reply.status == StatusCode::TOO_MANY_REQUESTS {
            assert!(reply.has("has changed too much"), "{}", reply.text);
            break;
        }
        assert_eq!(reply.status, StatusCode::OK);
        let removed = user.post("/account/tokens/loop/remove", &[]).await;
        assert_eq!(removed.location(), "/account?done=token");
        made += 1;
    }
    assert_eq!(made, 20);
    let mut other = Browser::of(&cloud, "bob", Role::Viewer).await;
    let fields = [("name", "nightly"), ("role", "viewer"), ("days", "1")];
    assert_eq!(other.post("/account/tokens", &fields).await.status, StatusCode::OK);
}
